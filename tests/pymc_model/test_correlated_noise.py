"""Noise that is moved: fresh at correlation 0, the same at 1, and an autoregression between."""

from dataclasses import replace

import numpy as np
import pymc as pm
import pytensor
import pytest
from pytensor.graph.replace import clone_replace

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood, StoredNoise
from pymc_statespace_filters.pymc_model.graph_rewrites import autoregressive_noise
from pymc_statespace_filters.pymc_model.inspection import health_outputs, noise_seeds

STEPS = np.array([1, 3, 4])
OBSERVED = np.array([0.3, np.nan, -0.2])


def system(n_states=1, **changes):
    settings = {
        "transition": lambda x, q, a: [a * x[i] + q[i] for i in range(n_states)],
        "observation": lambda x: [x[0]],
        "process_noise": np.eye(n_states),
        "observation_noise": [[0.5]],
        "initial_mean": np.zeros(n_states),
        "initial_cov": np.eye(n_states),
    }
    return psf.StateSpaceModel(**settings | changes)


def one_variable(filter, system_=None):
    with pm.Model() as model:
        a = pm.Normal("a")
        psf.StateSpace(
            "d", system_ or system(), filter=filter, params={"a": a},
            observed=OBSERVED[:, None], steps=STEPS,
        )  # fmt: skip
    return model


def moving(model):
    """Compile: (a, correlation, normals, seed) -> log-density, health, moved normals, size."""
    logp, seeds = model.logp(), noise_seeds(model)
    (logp, health), noise = autoregressive_noise([logp, *health_outputs([logp])], seeds)
    outputs = [logp, health, noise.moved[0], noise.sizes[0]]
    seed = seeds["d"].type("seed")
    outputs = clone_replace(outputs, {seeds["d"]: seed})
    inputs = [*model.value_vars, noise.correlation, *noise.normals, seed]
    return pytensor.function(inputs, outputs, mode="NUMBA")


FILTERS = [
    (psf.BootstrapPF(40), psf.BootstrapPF(40, resampling="sorted", resample_below=1)),
    (psf.EnKF(40), psf.EnKF(40)),
]


def test_the_smooth_version_keeps_all_other_settings():
    nudged = psf.PFEnKF(70, resample_below=0.5, likelihood="weights")
    always = replace(nudged, resampling="sorted", resample_below=1)
    for filter, smooth in [*FILTERS, (nudged, always)]:
        assert (
            filter.smooth(compile_system(system()))
            == smooth
            == smooth.smooth(compile_system(system()))
        )
    # An order of two states is not exact: the threshold stays.
    assert nudged.smooth(compile_system(system(2))) == replace(nudged, resampling="sorted")


@pytest.mark.parametrize(("filter", "smooth"), FILTERS, ids=lambda f: type(f).__name__)
def test_estimates_are_those_of_the_smooth_filter_on_the_moved_normals(filter, smooth):
    function = moving(one_variable(filter))
    stored = evaluator(StoredNoise(system(), smooth))
    (u,), (v,) = stored(STEPS, 1), stored(STEPS, 2)
    by_seed = one_variable(smooth)
    logp = by_seed.compile_logp()
    (shared,) = [v for v in logp.f.get_shared() if v.name == "d_seed"]

    def of_seed(seed):
        shared.set_value(np.array(seed, dtype=np.int64))
        return logp({"a": 0.7})

    assert of_seed(1) != of_seed(2)
    for correlation, expected, seed in ((0.0, v, 2), (1.0, u, 1)):
        value, health, moved, size = function(0.7, correlation, u, 2)
        np.testing.assert_array_equal(moved, expected)
        assert value == of_seed(seed)
        assert health[1] == 0
        assert size == u.size == v.size
    _, _, moved, _ = function(0.7, 0.6, u, 2)
    np.testing.assert_allclose(moved, 0.6 * u + 0.8 * v, rtol=0, atol=1e-14)


def test_every_noisy_variable_has_normals_of_its_own():
    model = one_variable(psf.EnKF(40))
    with model:
        psf.StateSpace(
            "f", system(), filter=psf.BootstrapPF(20), params={"a": 0.5},
            observed=OBSERVED[:, None], steps=STEPS,
        )  # fmt: skip
        psf.StateSpace(
            "g", system(), filter=psf.EKF(), params={"a": model["a"]},
            observed=OBSERVED[:, None], steps=STEPS,
        )  # fmt: skip
    (logp,), noise = autoregressive_noise([model.logp()], noise_seeds(model))
    assert sorted(v.name for v in noise.normals) == ["d_normals", "f_normals"]
    nodes = [v.owner.op for v in pytensor.graph.traversal.ancestors([logp]) if v.owner is not None]
    filters = {op.filter for op in nodes if isinstance(op, LogLikelihood)}
    smooth = psf.BootstrapPF(20, resampling="sorted", resample_below=1)
    assert filters == {psf.EnKF(40), smooth, psf.EKF()}
    sizes = pytensor.function([], noise.sizes)()
    first = moving(one_variable(psf.EnKF(40)))
    assert first(0.0, 0.0, np.zeros(int(sizes[0])), 1)[3] == sizes[0]


def test_without_noise_nothing_moves():
    model = one_variable(psf.EKF())
    (logp,), noise = autoregressive_noise([model.logp()], noise_seeds(model))
    assert noise[1:] == ((), (), ())
    assert pytensor.function(model.value_vars, logp)(0.7) == model.compile_logp()({"a": 0.7})


def test_too_many_states_for_an_order_are_refused():
    wide = system(9)
    model = one_variable(psf.BootstrapPF(20), wide)
    message = "resampling='sorted' orders particles of at most 8 states, this system has 9"
    with pytest.raises(psf.errors.ModelError, match=message):
        autoregressive_noise([model.logp()], noise_seeds(model))
    for filter in (psf.BootstrapPF, psf.PFEnKF):
        with pytest.raises(psf.errors.ModelError, match=message):
            one_variable(filter(20, resampling="sorted"), wide)
    autoregressive_noise([one_variable(psf.EnKF(20), wide).logp()], noise_seeds(model))
