"""Numbers that a model fixes are in the equations before anything is asked of a system.

The values are those of the equations written without them.
"""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from tests.states.models import posterior

pytestmark = pytest.mark.usefixtures("interpreted")

SEEN = dict(
    observation=lambda x: [x[0]], observation_noise=[[0.1]], initial_mean=[1.0],
    initial_cov=[[0.1]],
)  # fmt: skip


def drifting(drift, noise=lambda s: [[s]], **changes):
    return psf.StateSpaceModel(psf.EulerMaruyama(drift, noise, dt=0.1), **SEEN | changes)


WELLS = drifting(lambda x, a, b=0.0: [a * x[0] + b * x[0] ** 3])
STEPS, DATA = [3, 6, 9], [1.0, 0.8, 0.5]


def model_of(system, filter, free=("a", "s"), **settings):
    given = {"steps": STEPS, "observed": DATA} | settings
    with pm.Model() as model:
        for name in free:
            pm.Normal(name)
        psf.StateSpace("d", system, filter, **given)
    return model


def is_exact(model):
    op = model["d"].owner.op
    return op.filter.is_exact_for(compile_system(op.system))


FIXED = {
    "default": (WELLS, {}),
    "number": (WELLS, {"b": 0}),
    "symbol": (WELLS, {"b": pt.as_tensor(0.0)}),
    "power": (drifting(lambda x, a, p: [-a * x[0] ** p]), {"p": 1.0}),
    "noise": (drifting(lambda x, a: [a * x[0]], lambda x, s, g: [[s * x[0] ** g]]), {"g": 0.0}),
    "vector": (
        drifting(lambda x, a, c: [a * x[0] + c[0] * pt.sin(c[1] * x[0])], shapes={"c": (2,)}),
        {"c": [1.0, 0.0]},
    ),
    "switch": (
        drifting(lambda x, a, up, down: [a * x[0] + pt.switch(x[0] > 0, up, down)]),
        {"up": 0.3, "down": 0.3},
    ),
    "sensor": (
        drifting(lambda x, a: [a * x[0]], observation=lambda x, c: [x[0] + c * x[0] ** 2]),
        {"c": 0.0},
    ),
}


@pytest.mark.parametrize("case", list(FIXED))
def test_a_system_is_linear_where_a_model_fixes_what_bends_it(case):
    system, params = FIXED[case]
    assert is_exact(model_of(system, psf.EKF(), params=params))


def test_it_is_not_where_the_number_is_another_or_may_change():
    assert not is_exact(model_of(WELLS, psf.EKF(), params={"b": 0.1}))
    assert not is_exact(model_of(WELLS, psf.EKF(), free=("a", "b", "s")))
    with pm.Model() as model:
        for name in "as":
            pm.Normal(name)
        pm.Data("b", 0.0)
        psf.StateSpace("d", WELLS, psf.EKF(), steps=STEPS, observed=DATA)
    assert not is_exact(model)


def test_a_rival_has_the_check_of_a_linear_system_and_the_code_of_the_whole_one():
    rival = model_of(WELLS, psf.EKF())
    table = psf.check_filter(posterior(a=np.ones((1, 2)), s=np.ones((1, 2))), rival)
    assert table["outcome"].tolist() == ["exact"]
    asked, whole = (compile_system(one) for one in (rival["d"].owner.op.system, WELLS))
    assert asked is not whole
    assert asked.model is whole.model  # of which machine code is made
    assert rival["d"].owner.op.system.fingerprint == WELLS.fingerprint


def test_particles_of_a_rival_are_guided_as_those_of_a_linear_system():
    point = {"a": -0.5, "s": 0.4}
    found = [
        model_of(WELLS, filter).compile_logp(sum=False)(point)[-1].sum()
        for filter in (psf.EKF(), psf.GuidedPF(10))
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-10)


def test_a_filter_takes_what_its_equations_are_with_these_numbers():
    """Noise of a power of zero is additive; trials of a given number are finitely many."""
    powers = drifting(lambda x, a: [a * x[0]], lambda x, s, g: [[s * pt.abs(x[0]) ** g]])
    grid = model_of(powers, psf.GridFilter(), params={"g": 0.0})
    assert is_exact(grid)
    point = {"a": -0.5, "s": 0.4}
    found = [
        model.compile_logp(sum=False)(point)[-1].sum()
        for model in (grid, model_of(WELLS, psf.EKF()))
    ]
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)
    trials = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]], process_dist=lambda x, n, p: [pm.Binomial.dist(n, p)],
        observation=lambda x, a: [a * x[0]], observation_noise=[[0.5]], initial_mean=[1.0],
        initial_cov=[[0.0]],
    )  # fmt: skip
    chain = model_of(trials, psf.FiniteStateFilter(), free=("a", "p"), params={"n": 5})
    term = chain.compile_logp(sum=False)({"a": 0.3, "p": 0.4})[-1].sum()
    counts = np.arange(6)
    each = stats.norm.pdf(np.array(DATA)[:, None], 0.3 * counts, np.sqrt(0.5))
    exact = np.log(each @ stats.binom.pmf(counts, 5, 0.4)).sum()
    np.testing.assert_allclose(term, exact, rtol=1e-10)
    with pytest.raises(psf.errors.ModelError, match="number of trials is not a number"):
        model_of(trials, psf.FiniteStateFilter(), free=("a", "p", "n"))
