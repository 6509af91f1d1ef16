"""Filters from a user's own file, which inherit nothing from the package, work everywhere."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytest
from numba import njit

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters import (
    CompiledFunction,
    EnsembleFilter,
    Filter,
    RunFilter,
    StatesFilter,
)
from pymc_statespace_filters.ops import at_points
from pymc_statespace_filters.ops.states import States
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.linear_states import linear_states

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "filter.md"
# One system with everything, inputs included: the filter of the page is compiled for each.
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, u, a: [a * x[0] + 0.1 * x[1] + u[0] + q[0], 0.9 * x[1] + q[1]],
    process_noise=[[0.5, 0.1], [0.1, 0.3]],
    observation=lambda x: [x[0], x[0] - x[1]],
    observation_noise=[[0.4, 0.1], [0.1, 0.2]],
    initial_mean=[0.5, 0.0],
    initial_cov=[[1.0, 0.2], [0.2, 0.5]],
    inputs=["force"],
)
RECORD_STEPS = np.array([0, 1, 3, 4, 8])
RECORD = np.array([[0.3, 0.1], [1.2, np.nan], [np.nan, np.nan], [0.4, 0.2], [-0.3, 0.5]])
FORCE = np.array([0.5, -0.2, 0.1, 0.3, 0.0, -0.4, 0.2, 0.6])
RUN = {"observed": RECORD, "steps": RECORD_STEPS, "inputs": FORCE}


def linear(a):
    """The same system as the arguments of exact references."""
    return (
        np.array([[a, 0.1], [0.0, 0.9]]),
        np.array([[0.5, 0.1], [0.1, 0.3]]),
        np.array([[1.0, 0.0], [1.0, -1.0]]),
        np.array([[0.4, 0.1], [0.1, 0.2]]),
        np.array([0.5, 0.0]),
        np.array([[1.0, 0.2], [0.2, 0.5]]),
    )


EXACT_RUN = RUN.copy()
EXACT_RUN["forcing"] = np.column_stack([EXACT_RUN.pop("inputs"), np.zeros(8)])


def exact_terms(a):
    return kalman_log_likelihood(*linear(a), **EXACT_RUN)


def exact_states(a, rows):
    return linear_states(*linear(a), **EXACT_RUN, rows=rows, moment="filtered")


@pytest.fixture(scope="module")
def cubature():
    """The filter of the page "A new filter", from its definitions alone."""
    cells = re.findall(r"```\{code-cell\} python3\n(.*?)```", PAGE.read_text(), re.DOTALL)
    definitions = [cell for cell in cells if re.search(r"^(@njit|@dataclass|from )", cell, re.M)]
    namespace = {"__name__": "a_users_file"}
    exec("\n".join(definitions), namespace)
    return namespace["CubatureKF"]()


@dataclass(frozen=True)
class PlainParticles:
    """A noisy filter with the least there can be: no members, no states, no stored noise.

    Its function is decorated by numba's own ``njit``, and has no key.
    """

    n: int
    noisy: ClassVar[bool] = True
    has_gradient: ClassVar[bool] = False

    def check(self, system):
        if system.carried:
            raise psf.errors.ModelError("no carried states")

    def is_exact_for(self, system):
        return True

    def compile(self, system):
        bootstrap = psf.BootstrapPF(self.n).compile(system).function

        @njit
        def likelihood(theta, steps, observed, inputs, t0, seed):
            return bootstrap(theta, steps, observed, inputs, t0, seed)

        return CompiledFunction(likelihood)


def model_of(filter):
    with pm.Model() as model:
        pm.Uniform("a", -1.0, 1.0)
        psf.StateSpace("d", SYSTEM, filter, **RUN)
    return model


def test_what_an_outside_filter_is(cubature):
    assert type(cubature).__mro__[1:] == (object,)
    assert isinstance(cubature, Filter)
    assert isinstance(cubature, RunFilter)
    assert isinstance(cubature, StatesFilter)
    assert not isinstance(cubature, EnsembleFilter)
    assert isinstance(PlainParticles(50), Filter)
    assert not isinstance(PlainParticles(50), StatesFilter)


def test_its_likelihood_is_exact_on_linear_systems(cubature):
    for a in (0.3, 0.8):
        terms = psf.log_likelihood(SYSTEM, cubature, {"a": a}, **RUN)
        np.testing.assert_allclose(terms, exact_terms(a), rtol=1e-9)


def test_its_states_are_exact_on_linear_systems(cubature):
    run = psf.run_filter(SYSTEM, cubature, {"a": 0.7}, **RUN, at="steps")
    exact = exact_states(0.7, np.arange(9))
    np.testing.assert_allclose(run["mean"], exact.mean, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(run["sd"], exact.sd, rtol=1e-8)
    cov = np.einsum("iaib->iab", exact.cov)
    np.testing.assert_allclose(run["cov"], cov, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(run["log_likelihood"], exact_terms(0.7), rtol=1e-8, atol=1e-12)


def test_it_is_sampled_and_gives_evidence_and_states(cubature):
    # Without numba PyTensor calls the machine code of the likelihood, which is there already.
    with pytensor.config.change_flags(mode="FAST_COMPILE"), model_of(cubature):
        idata = psf.sample_dram(
            400,
            tune=200,
            chains=2,
            random_seed=3,
            progressbar=False,
            compute_convergence_checks=False,
        )
        evidence = psf.chib_jeliazkov(idata, random_seed=1)
        states = psf.filtered_states(idata, n_draws=4, random_seed=2)["filtered_states"]
        with pytest.raises(psf.errors.ModelError, match="does not smooth; take filter="):
            psf.smoothed_states(idata)
    assert idata.attrs["exact"]
    grid = np.linspace(-1.0, 1.0, 401)
    likelihood = np.exp([exact_terms(a).sum() for a in grid])
    exact = np.log(np.trapezoid(likelihood, grid) / 2.0)
    assert evidence.log_evidence == pytest.approx(exact, abs=4 * evidence.se + 1e-3)
    assert evidence.se < 0.1
    chosen = states["draw"].values[0]
    a = float(idata.posterior["a"].isel(chain=0).sel(draw=chosen))
    mean = exact_states(a, RECORD_STEPS).mean
    np.testing.assert_allclose(states["d_mean"].values[0, 0], mean, rtol=1e-6, atol=1e-8)


def test_all_records_of_a_panel_share_one_function(cubature, monkeypatch):
    """It takes seconds to compile."""
    at_points._without_plan.cache_clear()  # another test may have made it
    made = []

    def function(inputs, outputs, *arguments, _function=pytensor.function, **options):
        nodes = [out.owner for out in outputs if out.owner] if isinstance(outputs, list) else []
        made.extend(node for node in nodes if isinstance(node.op, States))
        return _function(inputs, outputs, *arguments, **options)

    monkeypatch.setattr(pytensor, "function", function)
    a = np.array([0.2, 0.7, -0.4])
    with pytensor.config.change_flags(mode="FAST_COMPILE"), pm.Model() as model:
        pm.Normal("a", shape=3)
        psf.StateSpace(
            "d", SYSTEM, cubature, steps=np.tile(RECORD_STEPS, 3), inputs=FORCE,
            observed=np.tile(RECORD, (3, 1)), panel=np.repeat([1, 2, 3], 5),
        )  # fmt: skip
        draws = az.from_dict({"posterior": {"a": a[None, None]}})
        states = psf.filtered_states(draws, model, random_seed=1)["filtered_states"]
    assert len(made) == 5  # which are the results of one
    exact = np.concatenate([exact_states(one, RECORD_STEPS).mean for one in a])
    np.testing.assert_allclose(states["d_mean"].values[0, 0], exact, rtol=1e-6, atol=1e-8)


def test_a_noisy_one_without_anything_else_is_sampled_with_fresh_noise():
    with model_of(PlainParticles(100)):
        idata = psf.sample_dram(
            50, tune=50, chains=2, random_seed=3, compute_convergence_checks=False
        )
        seeds = idata.sample_stats["d_seed"].values
        assert np.unique(seeds).size > 2
        with pytest.raises(
            psf.errors.ModelError, match=r"gives no states: it has no compile_states"
        ):
            psf.filtered_states(idata)
        with pytest.raises(psf.errors.ModelError, match="correlation needs a filter whose normals"):
            psf.sample_dram(5, tune=5, chains=1, kernel={"stages": 1, "correlation": 0.9})


@pytest.mark.parametrize("filter", [psf.EKF, PlainParticles, "EKF", None])
def test_what_is_no_filter_is_refused(filter):
    with pytest.raises(psf.errors.ModelError, match=r"filter must be a filter such as psf.EKF\(\)"):
        psf.log_likelihood(SYSTEM, filter, {"a": 0.5}, **RUN)
