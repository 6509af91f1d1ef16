"""Draws in the equations of a system: loops in stages, interpreted graphs, derivatives."""

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import FilterWarning, LoweringError
from pymc_statespace_filters.system import quantiles as law
from tests.modes import AS_IT_STANDS

M, N = 6, 131  # two blocks of members and a rest
C = np.array([0.8])


def epidemic(x, q, b):
    """Draws that depend on others, by sums, switches, truth values and whole numbers."""
    susceptible, ill, seen = x[0], x[1], x[2]
    infected = law.binomial_quantile(q[0], susceptible, 1.0 - pt.exp(-b * ill / (10.0 + x.sum())))
    recovered = law.binomial_quantile(q[1], ill + infected, 0.3)
    many = infected > 3.0
    imported = law.poisson_quantile(q[2], law.gamma_quantile(q[3], 0.5 + b, 4.0))
    noticed = law.bernoulli_quantile(q[4], 0.5) * pt.switch(many, recovered, 1.0)
    late = law.poisson_quantile(q[5], pt.switch(many & (imported > 0.0), 20.0, b))
    return [
        susceptible - infected,
        ill + infected - recovered + imported,
        seen + noticed + late * many + pt.floor(b * ill) % 3,
    ]


def system(transition, n=3, m=M):
    return psf.StateSpaceModel(
        transition=transition,
        process_noise=np.eye(m),
        observation=lambda x: [x[1]],
        observation_noise=[[9.0]],
        initial_mean=[1000.0, 10.0, 0.0][:n],
        initial_cov=np.zeros((n, n)),
    )


def members():
    rng = np.random.default_rng(0)
    X = np.array([rng.integers(0, 2000, N), rng.integers(0, 200, N), np.zeros(N)], float)
    return X, rng.normal(size=(M, 192))


def propagated(machine, X, Z):
    X = X.copy()
    machine.propagate.function(
        machine.prepare.function(C), np.zeros((0, 0)), 0, 0.0, np.ascontiguousarray(Z), X
    )
    return X


def test_a_step_is_that_of_the_interpreted_graph():
    X, Z = members()
    x, q, b = pt.vector("x"), pt.vector("q"), pt.scalar("b")
    interpreted = pytensor.function([x, q, b], pt.stack(epidemic(x, q, b)), mode=AS_IT_STANDS)
    expected = [interpreted(X[:, i], Z[:, i], *C) for i in range(N)]
    got = propagated(compile_system(system(epidemic)), X, Z)
    np.testing.assert_array_equal(got.T, expected)
    assert len(np.unique(got)) > 100


def test_bits_do_not_depend_on_the_place_of_a_member():
    X, Z = members()
    machine = compile_system(
        system(lambda x, q, b: [
            law.gamma_quantile(q[0], x[0] + 0.1, b), law.gamma_quantile(q[1], 1.0 + x[1], b), x[2],
        ])
    )  # fmt: skip
    X[0] = np.geomspace(1e-3, 1e3, N)
    whole = propagated(machine, X, Z)
    for members_of in (slice(0, 1), slice(0, 7), slice(65, 70), slice(128, 131)):
        part = propagated(machine, X[:, members_of], Z[:, members_of])
        np.testing.assert_array_equal(part, whole[:, members_of])


def test_machine_code_of_pytensor_has_them_too():
    z, mu = pt.vector("z"), pt.scalar("mu")
    draws = pytensor.function([z, mu], law.poisson_quantile(z, mu), mode="NUMBA")
    np.testing.assert_array_equal(draws(np.array([-1.0, 0.0, 2.0, 6.0]), 5.0), [3, 5, 10, 23])


def test_an_invalid_parameter_is_a_failure_that_is_counted():
    count = system(lambda x, q, b: [x[0], law.poisson_quantile(q[0], b), x[2]])
    with pytest.warns(FilterWarning, match="overflowed or became NaN"):
        found = psf.log_likelihood(
            count, psf.BootstrapPF(32), {"b": -1.0}, np.zeros((2, 1)), steps=[1, 2]
        )
    assert found.sum() == -np.inf


def test_a_filter_that_needs_a_derivative_is_refused():
    with pytest.raises(LoweringError, match="the derivative of PoissonQuantile by its argument"):
        psf.log_likelihood(system(epidemic), psf.EKF(), {"b": 0.8}, np.zeros((2, 1)), steps=[1, 2])


def test_derivatives_do_not_pretend_that_noise_is_additive():
    machine = compile_system(system(lambda x, q, b: [x[0] + law.poisson_quantile(q[0], x[1]),
                                                     x[1], x[2]], m=1))  # fmt: skip
    assert not machine.has_additive_process_noise
