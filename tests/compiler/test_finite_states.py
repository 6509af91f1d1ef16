"""Which states take finitely many values, which values, and what leads to which."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.stats import binom

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.finite_states import (
    finite_states,
    step_given_values,
)
from pymc_statespace_filters.compiler.lowering.given_regime import given_regime
from pymc_statespace_filters.compiler.lowering.known_values import known_values
from pymc_statespace_filters.errors import ModelError


def system(transition, process_dist, n, **settings):
    """A system that starts at (1, 0, ..)."""
    given = {
        "observation": lambda x: [x[0]], "observation_noise": [[1.0]],
        "initial_mean": np.eye(n)[0], "initial_cov": np.zeros((n, n)),
    }  # fmt: skip
    return psf.StateSpaceModel(transition, process_dist=process_dist, **given | settings)


MEMORY = system(
    lambda x, q: [q[0], x[0]],
    lambda x, a, b: [pm.Bernoulli.dist(pt.switch(pt.eq(x[0], 0), a, b))],
    2,
    initial_mean=None, initial_cov=None,
    initial_dist=lambda a: [pm.Bernoulli.dist(a), 0],
)  # fmt: skip
INFECTED = system(
    lambda x, q: [x[0] - q[0], x[1] + q[0] - q[1]],
    lambda x, b, g: [pm.Binomial.dist(x[0], 1 - pt.exp(-b * x[1])), pm.Binomial.dist(x[1], g)],
    2,
    initial_mean=[3.0, 1.0],
)
SWITCHING = system(
    lambda x, q: [q[0], 0.9 * x[1] + pt.switch(pt.eq(q[0], 1), 2.0, 1.0) * q[1]],
    lambda x, a, s: [pm.Categorical.dist(pt.stack([a, 1 - a, 0.0])), pm.Normal.dist(0, s)],
    2,
    observation=lambda x: [x[0] + x[1]],
    initial_cov=[[0.0, 0.0], [0.0, 4.0]],
)


def test_regime_and_its_memory():
    """Both are finite; a memory follows the regime that it had."""
    found = finite_states(MEMORY)
    assert (found.indices, found.continuous) == ((0, 1), ())
    assert found.joint.tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert found.start.successor.tolist() == [0, 2]
    before, after = found.joint[found.step.origin], found.joint[found.step.successor]
    assert (after[:, 1] == before[:, 0]).all()
    assert (after[:, 0] == found.step.values[:, 0]).all()


def test_counts_of_a_closed_population():
    """The triangle of all (S, I), with as many moves as there are new cases and recoveries."""
    found = finite_states(INFECTED)
    joint = set(map(tuple, found.joint))
    assert joint == {(s, i) for s in range(4) for i in range(5) if s + i <= 4}
    assert found.step.origin.size == sum((s + 1) * (i + 1) for s, i in joint) - 1 * 2 - 1 - 3


@pytest.mark.parametrize("model", [MEMORY, INFECTED])
def test_probabilities_of_moves_add_up_to_one(model):
    """From every joint value."""
    found, step = finite_states(model), step_given_values(model)
    moves = found.step
    given = {f"theta.{i}": np.full(moves.origin.size, 0.3 + 0.1 * i) for i in range(2)}
    given |= {f"x.{i}": found.joint[moves.origin, i] for i in range(2)}
    given |= {f"v.{i}": column for i, column in enumerate(moves.values.T)}
    factors = known_values(step.probability, given, moves.origin.size)
    assert all(factor.everywhere for factor in factors)
    product = np.prod([factor.value for factor in factors], axis=0)
    np.testing.assert_allclose(np.bincount(moves.origin, product), 1.0, rtol=1e-12)


def test_probability_of_a_binomial_move():
    """That of scipy, and none outside of what the state allows."""
    model = system(lambda x, q: [x[0] - q[0]], lambda x, p: [pm.Binomial.dist(x[0], p)], 1,
                   initial_mean=[5.0])  # fmt: skip
    found, step = finite_states(model), step_given_values(model)
    state, drawn = found.joint[found.step.origin, 0], found.step.values[:, 0]
    assert found.joint[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert (drawn <= state).all()
    given = {"theta.0": np.full(len(drawn), 0.2), "x.0": state, "v.0": drawn}
    (known,) = known_values(step.probability, given, len(drawn))
    np.testing.assert_allclose(known.value, binom.pmf(drawn, state, 0.2), rtol=1e-12)


def test_continuous_states_are_named_with_reasons():
    """A regime beside a normal state; a category of probability zero is none."""
    found = finite_states(SWITCHING)
    assert (found.indices, found.continuous) == ((0,), (1,))
    assert found.joint.tolist() == [[0], [1]]
    assert "infinitely many values" in found.why_not["x1"]


@pytest.mark.parametrize(
    ("transition", "why"),
    [
        (lambda x, q, a: [q[0] + a], "depends on parameters, inputs or time"),
        (lambda x, q: [x[0] + 1 + q[0]], "more than 1024 values"),
        (lambda x, q: [q[1]], "number of trials"),
    ],
)
def test_states_that_are_not_finite(transition, why):
    """Their messages say why."""
    model = system(
        transition, lambda x, n: [pm.Bernoulli.dist(0.5), pm.Binomial.dist(n, 0.5)], 1,
    )  # fmt: skip
    found = finite_states(model)
    assert found.indices == ()
    assert why in found.why_not["x0"]


def test_nothing_is_known_of_a_step_that_is_not_written_out():
    model = system(
        lambda x, q: [q[0], x[0]], lambda x: [pm.Bernoulli.dist(pt.sigmoid(pt.sort(x)[0]))], 2
    )
    assert finite_states(model).indices == ()


def test_declared_values():
    """They are reached although the start does not lead there, and no others may be."""
    model = system(lambda x, q: [x[0]], lambda x: [pm.Bernoulli.dist(0.5)], 1)
    assert finite_states(model).joint.tolist() == [[1]]
    assert finite_states(model, (("x0", (0.0, 1.0, 2.0)),)).joint.tolist() == [[0], [1], [2]]
    with pytest.raises(ModelError, match="'x0' must stay within"):
        finite_states(
            system(lambda x, q: [2 * q[0]], lambda x: [pm.Bernoulli.dist(0.5)], 1),
            (("x0", (0.0, 1.0)),),
        )


def test_system_given_its_regimes():
    """Along given regimes it is linear and Gaussian: a Kalman filter by hand."""
    inner = given_regime(SWITCHING, finite_states(SWITCHING))
    now, drawn = np.array([1.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 1.0, 0.0])
    observed = np.array([[1.0], [0.3], [1.5], [2.0]])
    found = psf.log_likelihood(
        inner, psf.EKF(), {"a": 0.3, "s": 0.5}, observed, steps=np.arange(4),
        inputs=np.column_stack([now, drawn]),
    )  # fmt: skip
    mean, variance, expected = 0.0, 4.0, []
    for k in range(4):
        spread, error = variance + 1.0, observed[k, 0] - mean - now[k]
        expected.append(-0.5 * (np.log(2 * np.pi * spread) + error**2 / spread))
        mean, variance = mean + variance / spread * error, variance / spread
        mean, variance = 0.9 * mean, 0.81 * variance + 0.25 * (1.0 + 3.0 * drawn[k])
    np.testing.assert_allclose(found, expected, rtol=1e-12)
