"""Libraries of terms: names, values, and systems whose coefficients are vectors."""

import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.mechanics import polynomial_terms

pytestmark = pytest.mark.usefixtures("interpreted")


def test_monomials_are_ordered_by_degree():
    terms = polynomial_terms(["v", "w"], 3)
    assert terms.names == (
        "1", "v", "w", "v^2", "v w", "w^2", "v^3", "v^2 w", "v w^2", "w^3"
    )  # fmt: skip
    v, w = 0.7, -1.3
    expected = [1, v, w, v**2, v * w, w**2, v**3, v**2 * w, v * w**2, w**3]
    np.testing.assert_allclose(terms([v, w]).eval(), expected, rtol=1e-15)
    assert len(terms) == 10
    assert len(polynomial_terms(["a", "b", "c"], 2, lowest=1)) == 9


def test_further_terms_get_states_and_parameters_by_name():
    terms = polynomial_terms(
        ["z", "v"], 1, also={"slip": lambda v, gap, rate=2.0: pt.tanh(rate * v) + gap}
    )
    assert terms.names == ("1", "z", "v", "slip")
    assert terms.parameters == ("gap", "rate")
    expected = [1.0, 0.5, 0.3, np.tanh(0.6) + 0.1]
    np.testing.assert_allclose(terms([0.5, 0.3], gap=0.1).eval(), expected)


def test_terms_at_many_states_have_their_shape():
    grid = np.linspace(-1, 1, 5)
    terms = polynomial_terms("z", 2, also={"one half": lambda z: 0.5})
    expected = [np.ones(5), grid, grid**2, np.full(5, 0.5)]
    np.testing.assert_allclose(terms([grid]).eval(), expected)


def test_a_drift_of_a_library_is_that_written_by_hand():
    terms = polynomial_terms(["v", "w"], 2)
    a, b = np.array([0.5, 1.0, -1.0, -0.2, 0.1, 0.0]), np.array([0.1, 0.1, -0.1, 0.0, 0.3, 0.2])

    def from_library(x, a, b):
        return [a @ terms(x), b @ terms(x)]

    def by_hand(x, a, b):
        v, w = x
        monomials = [1, v, w, v * v, v * w, w * w]
        return [sum(c[i] * monomials[i] for i in range(6)) for c in (a, b)]

    def paths(drift):
        system = psf.StateSpaceModel(
            transition=psf.EulerMaruyama(drift, 0.1 * np.eye(2), dt=0.05),
            observation=lambda x: [x[0]],
            observation_noise=[[0.01]],
            initial_mean=[0.0, 0.0],
            initial_cov=np.eye(2),
            states=terms.states,
            shapes={"a": (len(terms),), "b": (len(terms),)},
        )
        return psf.simulate(system, {"a": a, "b": b}, steps=range(20), random_seed=1)

    one, other = paths(from_library), paths(by_hand)
    np.testing.assert_allclose(one["states"], other["states"], rtol=1e-12)


@pytest.mark.parametrize(
    ("states", "degree", "settings", "message"),
    [
        ([], 2, {}, "states must name at least one state, got"),
        (["v", "v"], 2, {}, "states must be distinct names"),
        ("v", 0.5, {}, "degree must be an integer"),
        ("v", 1, {"lowest": 2}, "degree must be an integer of at least 2, got 1"),
        ("v", 2, {"also": {"v^2": lambda v: v * v}}, r"also must not name monomials .*\['v\^2'\]"),
        ("v", 2, {"also": {"drag": 3.0}}, "drag must be a function, got 3.0"),
    ],
)
def test_bad_libraries_are_refused(states, degree, settings, message):
    with pytest.raises(ModelError, match=message):
        polynomial_terms(states, degree, **settings)


def test_bad_calls_are_refused():
    terms = polynomial_terms(["z", "v"], 1, also={"gap": lambda z, gap: abs(z) - gap})
    with pytest.raises(ModelError, match=r"x must hold the states of the library, .* got 3"):
        terms([0.0, 0.0, 0.0], gap=1.0)
    with pytest.raises(ModelError, match=r"parameters by name, \['gap'\], got \['width'\]"):
        terms([0.0, 0.0], width=1.0)
    with pytest.raises(ModelError, match="gap could not be traced"):
        polynomial_terms("z", 1, also={"gap": lambda z: z.missing})(1.0)
