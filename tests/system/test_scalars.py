"""One component may be written as a scalar: the system is that of the lists."""

import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf

LISTS = dict(
    transition=lambda x, q, a: [a * x[0] + q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.04]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


@pytest.mark.parametrize(
    ("scalars", "lists"),
    [
        (dict(initial_mean=0.0, initial_cov=1.0, observation_noise=0.04, process_noise=1), {}),
        (dict(initial_mean=np.float64(0.0), initial_cov=np.array(1.0)), {}),
        (dict(transition=lambda x, q, a: a * x[0] + q[0], observation=lambda x: x[0]), {}),
        (dict(process_noise=lambda s: s**2), dict(process_noise=lambda s: [[s**2]])),
        (dict(observation_noise=lambda s: s), dict(observation_noise=lambda s: [[s]])),
        (dict(initial_cov=lambda s: 2.0), dict(initial_cov=lambda s: [[2.0]])),
        (dict(initial_mean=lambda m: m / 2), dict(initial_mean=lambda m: [m / 2])),
        (
            dict(observation=lambda x, e: x[0] * pt.exp(e[0]), observation_noise=0.1),
            dict(observation=lambda x, e: [x[0] * pt.exp(e[0])], observation_noise=[[0.1]]),
        ),
    ],
)
def test_a_scalar_is_the_list_of_one(scalars, lists):
    written = psf.StateSpaceModel(**LISTS | scalars)
    assert written == psf.StateSpaceModel(**LISTS | lists)
    assert (written.n, written.m, written.p, written.r) == (1, 1, 1, 1)


@pytest.mark.parametrize("diffusion", [0.6, lambda sigma: sigma, lambda x, s: s * x[0]])
def test_scalars_of_an_integrator(diffusion):
    def euler(drift, diffusion):
        step = psf.EulerMaruyama(drift, diffusion, dt=0.1)
        return psf.StateSpaceModel(**LISTS | dict(transition=step, process_noise=None))

    matrix = {1: lambda sigma: [[sigma]], 2: lambda x, s: [[s * x[0]]]}
    n_arguments = diffusion.__code__.co_argcount if callable(diffusion) else 0
    listed = euler(lambda x, a: [-a * x[0]], matrix.get(n_arguments, [[0.6]]))
    assert euler(lambda x, a: -a * x[0], diffusion) == listed


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(initial_mean=[0.0, 0.0], initial_cov=np.eye(2)), r"transition .*one expression per"),
        (dict(observables=["a", "b"]), r"observation .*one expression per"),
        (dict(initial_cov=[1.0]), r"initial_cov .*square matrix, got shape \(1,\)"),
    ],
)
def test_a_scalar_is_not_repeated_for_several(changes, words):
    scalars = dict(transition=lambda x, q, a: a * x[0] + q[0], observation=lambda x: x[0])
    with pytest.raises(psf.errors.ModelError, match=words):
        psf.StateSpaceModel(**LISTS | scalars | changes)
