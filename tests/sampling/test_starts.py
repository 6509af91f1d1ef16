"""`find_starts`: points of the posterior, in all its modes, whatever the prior."""

from collections import Counter

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import kstest, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.rows import Rows
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.outcomes import Failure, why_zero
from pymc_statespace_filters.pymc_model.graph_rewrites import expensive_variables, pilot_filters
from pymc_statespace_filters.sampling.starts.annealing import Population, anneal
from pymc_statespace_filters.sampling.starts.population import population_of
from pymc_statespace_filters.sampling.target.log_density import LogDensity
from pymc_statespace_filters.sampling.target.target import Target
from tests.modes import AS_IT_STANDS
from tests.systems import autoregression, simulated


def starts_of(model, chains=4, seed=1):
    return psf.find_starts(model, chains=chains, random_seed=seed, progressbar=False)


def test_are_distributed_as_a_narrow_posterior():
    """The posterior is 3000 times narrower than the prior; Kolmogorov-Smirnov at 0.1 %."""
    exact = norm(2.0, 0.1)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 300.0, shape=2)
        pm.Normal("y", mu, 0.1, observed=[2.0, -5.0])
    found = np.array([start["mu"] for start in starts_of(model, 256)])
    assert found.shape == (256, 2)
    for component, shift in zip(found.T, (0.0, 7.0), strict=True):
        # moves leave some points in one place: count those that differ
        assert kstest(np.unique(component) + shift, exact.cdf).pvalue > 0.001
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.3


def test_are_in_both_modes_in_proportion_to_their_mass():
    """Over three seeds the share of the smaller mode is 0.3 with a standard deviation of 0.04."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 10.0)
        modes = [pt.log(w) + pm.logp(pm.Normal.dist(m, 0.05), x) for w, m in ((0.7, -4), (0.3, 4))]
        pm.Potential("likelihood", pt.logaddexp(*modes))
    shares = [
        np.mean([start["x"] > 0 for start in starts_of(model, 256, seed)]) for seed in range(3)
    ]
    assert np.mean(shares) == pytest.approx(0.3, abs=0.12)
    assert min(shares) > 0.05


def test_find_the_frequency_of_an_oscillation():
    """Chains that start at draws of the prior stay on ridges of other frequencies."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 60.0, 0.1)
    seen = 1.5 * np.sin(2.3 * t + 0.4) + 0.05 * rng.standard_normal(t.size)
    with pm.Model() as model:
        frequency = pm.LogNormal("frequency", 0.0, 1.0)
        amplitude = pm.HalfNormal("amplitude", 3.0)
        phase = pm.Normal("phase", 0.0, 1.0)
        sigma = pm.HalfNormal("sigma", 1.0)
        pm.Normal("y", amplitude * pt.sin(frequency * t + phase), sigma, observed=seen)
    log_density = model.compile_logp(mode=AS_IT_STANDS)
    for seed in (1, 2):
        for start in starts_of(model, seed=seed):
            assert start["frequency"] == pytest.approx(2.3, abs=0.003)
            assert start["sigma"] == pytest.approx(0.05, abs=0.01)
            assert np.isfinite(log_density(_transformed(model, start)))


def _transformed(model, start):
    return model.initial_point() | {
        model.rvs_to_values[rv].name: np.asarray(
            start[rv.name]
            if transform is None
            else transform.forward(start[rv.name]).eval(mode=AS_IT_STANDS)
        )
        for rv, transform in model.rvs_to_transforms.items()
        if rv in model.free_RVs
    }


def test_are_initial_values_of_both_samplers():
    with pm.Model():
        scale = pm.HalfNormal("scale", 10.0)
        share = pm.Dirichlet("share", np.ones(3))
        below = pm.Uniform("below", 0.0, scale)  # its transform depends on another variable
        pm.Normal("y", scale * share[0] + below, 1.0, observed=[1.0, 1.3])
        starts = psf.find_starts(chains=2, random_seed=1, progressbar=False)
        for start in starts:
            assert start["share"].sum() == pytest.approx(1.0)
            assert 0.0 < start["below"] < start["scale"]
        settings = {"chains": 2, "initvals": starts, "random_seed": 1, "progressbar": False}
        settings |= {"draws": 4, "tune": 0, "compute_convergence_checks": False}
        still = {"stages": 1, "proposal_cov": 1e-20 * np.eye(4)}
        with pytensor.config.change_flags(mode=AS_IT_STANDS):
            chains = psf.sample_dram(kernel=still, **settings)
            pm.sample(step=pm.Metropolis(), cores=1, **settings)
        for chain, start in enumerate(starts):
            for name, value in start.items():
                first = chains["posterior"][name].isel(chain=chain, draw=0)
                assert first.values == pytest.approx(value, rel=1e-6)


def test_noisy_likelihoods_and_seeds():
    with pm.Model() as model:
        params = {"phi": pm.Uniform("phi", 0.0, 1.0), "spread": pm.HalfNormal("spread", 1.0)}
        steps = np.arange(1, 11)
        observed = simulated(steps, 1, 0.8, 0.5)
        psf.StateSpace(
            "d", autoregression(), psf.BootstrapPF(20), params=params, steps=steps,
            observed=observed,
        )  # fmt: skip
    (first,), (again,), (other,) = (starts_of(model, 1, seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def _seen_by(filter):
    """Twenty rows of a linear-Gaussian state with an unknown persistence."""
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 1.0)
        observed = simulated(range(20), 1, phi=0.7, spread=1.0)
        params = {"spread": 1.0}
        psf.StateSpace(
            "d", autoregression(), filter, steps=range(20), observed=observed, params=params
        )
    return model


def test_a_grid_evaluates_only_what_its_coarse_form_has_found(monkeypatch):
    evaluated = Counter()
    call = Rows.__call__

    def counting(rows, x, *others):
        evaluated[rows] += len(x)
        return call(rows, x, *others)

    monkeypatch.setattr(Rows, "__call__", counting)
    rng = np.random.default_rng(1)
    found, _ = population_of(_seen_by(psf.GridFilter()), rng, progressbar=False)
    *others, last = evaluated.values()
    assert last == len(found.x) < sum(others) / 4
    exact = _seen_by(psf.EKF())  # Kalman's
    log_density = exact.compile_logp()
    expected = [log_density({"phi": x[0]}) for x in found.x[:20]]
    np.testing.assert_allclose(found.log_density[:20], expected, rtol=0, atol=20 * 1e-8)


@pytest.mark.parametrize("least", [0.0, 100.0])
def test_starts_have_a_positive_likelihood_where_the_coarse_one_has_too_many(monkeypatch, least):
    def coarse_density(target):
        return LogDensity(*target._shared, graph=target.model.logp(vars=target.model.free_RVs))

    monkeypatch.setattr(Target, "coarse_density", coarse_density)
    with pm.Model() as model:
        x = pm.Normal("x", 0, 1)
        pm.Potential("truncated", pt.switch(x > least, 0.0, -np.inf))
    if least == 100.0:
        with pytest.raises(ModelError, match="zero at all of 2000 draws"):
            starts_of(model)
    else:
        assert all(start["x"] > least for start in starts_of(model, 64))


def _decay(unit=1.0, **noise):
    """The model of a decaying state, whose sensor has its error in other units."""
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x, k: [-k * x[0]], [[0.0]], dt=0.1),
        observation=lambda x: [x[0]],
        observation_noise=lambda r: [[(r / unit) ** 2]],
        initial_mean=[1.0],
        initial_cov=[[0.0]],
    )
    steps = np.arange(1, 31)
    observed = psf.simulate(
        system, {"k": 1.0, "r": 0.1 * unit}, steps=steps, random_seed=1, **noise
    )["observations"]
    with pm.Model() as model:
        pm.HalfNormal("k", 2.0)
        pm.HalfNormal("r", 1.0)
        psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=observed)
    return model


def test_a_record_that_is_fitted_exactly_has_no_posterior():
    with pytest.raises(
        ModelError, match=r"no bound towards the lower end of r, because .* exactly"
    ):
        starts_of(_decay(noise=False))


def test_a_parameter_in_small_units_is_no_exact_fit():
    assert all(0.5e-10 < start["r"] < 2e-10 for start in starts_of(_decay(unit=1e-9)))
    clock = 1e-6 * np.arange(100.0) + np.random.default_rng(0).normal(0, 1e-11, 100)
    with pm.Model() as in_seconds:
        r = pm.HalfNormal("r", 1.0)
        pm.Normal("y", 1e-6 * np.arange(100.0), r, observed=clock)
    assert all(0.7e-11 < start["r"] < 1.4e-11 for start in starts_of(in_seconds))
    with pm.Model() as without_data:
        pm.Potential("p", -1e12 * pm.HalfNormal("r", 1.0))
    assert all(start["r"] < 2e-11 for start in starts_of(without_data))


def test_models_without_a_proper_prior_or_a_positive_likelihood_are_refused():
    with pm.Model() as improper:
        pm.Flat("x")
    with pytest.raises(ModelError, match="prior of x is improper"):
        psf.find_starts(improper)
    with pm.Model() as impossible:
        x = pm.Normal("x", 0, 1)
        pm.Potential("never", pt.switch(x > 100.0, 0.0, -np.inf))
    with pytest.raises(ModelError, match="zero at all of 2000 draws"):
        psf.find_starts(impossible, progressbar=False)
    with pm.Model() as discrete:
        pm.Poisson("n", 3)
    with pytest.raises(ModelError, match="discrete"):
        psf.find_starts(discrete)


class _GoesOn(Exception):
    """The search is past the temperature at which it gives up a posterior that is far away."""


def test_a_precise_posterior_of_many_parameters_is_not_taken_for_one_far_away():
    rng, n_calls = np.random.default_rng(0), 0

    def log_densities(x):
        nonlocal n_calls
        if (n_calls := n_calls + 1) > 301:  # three moves at each of a hundred temperatures
            raise _GoesOn
        return -0.5 * (x**2).sum(axis=1), -0.5 * ((x / 1e-5) ** 2).sum(axis=1)

    x = rng.normal(size=(200, 40))
    with pytest.raises(_GoesOn):
        anneal(Population(x, *log_densities(x)), log_densities, 200, rng)


SYSTEM = {
    "transition": lambda x, q: [0.9 * x[0] + q[0]], "process_noise": [[0.3]],
    "observation": lambda x: [x[0]], "observation_noise": [[0.1]],
    "initial_mean": [2.0], "initial_cov": [[1.0]],
}  # fmt: skip
COUNTS = SYSTEM | {
    "observation": None, "observation_noise": None,
    "observation_dist": lambda x, v: [pm.Poisson.dist(v + 0.0 * x[0])],
}  # fmt: skip
KNOWN_BY_DENSITY = SYSTEM | {
    "observation": None, "observation_noise": None,
    "observation_logp": lambda d, x, v: -0.5 * v * (d[0] - x[0]) ** 2,
}  # fmt: skip
GROWING = {"transition": lambda x, q, v: [1e30 * v * x[0] ** 5 + q[0]]}


@pytest.mark.parametrize(
    ("settings", "filter", "failure"),
    [
        (SYSTEM | {"process_noise": lambda v: [[v]]}, psf.EKF(), Failure.PROCESS_NOISE),
        (SYSTEM | {"initial_cov": lambda v: [[v]]}, psf.BootstrapPF(5), Failure.INITIAL_COV),
        (SYSTEM | {"observation_noise": lambda v: [[v]]}, psf.UKF(), Failure.OBSERVATION_NOISE),
        (COUNTS, psf.IPLF(), Failure.OBSERVATION_UNDEFINED),
        (SYSTEM | GROWING, psf.EKF(), Failure.STATE_NOT_FINITE),
    ],
    ids=lambda one: one.name if isinstance(one, Failure) else None,
)
def test_the_reason_of_a_likelihood_that_is_zero_at_all_draws(settings, filter, failure):
    with pm.Model() as model:
        pm.Normal("v", -1.0, 0.1)
        system = psf.StateSpaceModel(**settings)
        psf.StateSpace("d", system, filter, steps=[4, 5, 6], observed=np.ones(3))
    with pytest.raises(ModelError) as caught:
        psf.find_starts(model, progressbar=False)
    assert str(caught.value) == (
        "the likelihood is zero at all of 2000 draws of the prior: in 200 of 200 evaluations "
        f"{failure.message}. {failure.cure}"
    )


@pytest.mark.parametrize(
    ("failures", "text"),
    [
        ({}, "narrow the priors to plausible values"),
        (
            {Failure.ZERO_DENSITY: 3, Failure.TOO_FAR: 1},
            f"in 3 of 9 evaluations {Failure.ZERO_DENSITY.message}. {Failure.ZERO_DENSITY.cure}. "
            "Narrow the priors to plausible values",
        ),
        (
            {Failure.NOT_A_NUMBER: 9},
            "in 9 of 9 evaluations the log-density is NaN or plus infinity. Narrow the priors to "
            "plausible values",
        ),
    ],
)
def test_data_far_from_the_states_may_be_due_to_the_priors(failures, text):
    assert why_zero(Counter(failures), 9) == text


@pytest.fixture(scope="module")
def narrow():
    """A posterior a thousand times narrower than its prior, in three dimensions."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 100.0, shape=3)
        pm.Normal("y", mu, 0.1, observed=[2.0, -5.0, 30.0])
    return model


@pytest.fixture
def evaluated(monkeypatch):
    """Numbers of points that searches evaluate from now on."""
    found, call = [], Rows.__call__

    def counting(mapped, *columns):
        found.append(len(columns[0]))
        return call(mapped, *columns)

    monkeypatch.setattr(Rows, "__call__", counting)
    return found


@pytest.fixture
def expensive(monkeypatch):
    """Models count as having an expensive filter."""
    monkeypatch.setattr(Target, "is_expensive", True)


@pytest.mark.parametrize(
    ("filter", "is_expensive"),
    [
        (psf.EKF(), False),
        (psf.UKF(), False),
        (psf.GridFilter(), True),
        (psf.BootstrapPF(10), True),
        (psf.EnKF(10), True),
    ],
)
def test_filters_that_are_expensive(filter, is_expensive):
    with pm.Model() as model:
        pm.Normal("phi")
        params = {"spread": 1.0}
        psf.StateSpace("d", autoregression(), filter, steps=[1], observed=[0.3], params=params)
    assert bool(expensive_variables(model)) == is_expensive


@pytest.mark.parametrize(
    ("settings", "filter"),
    [
        (SYSTEM | {"observation_noise": lambda v: [[v]]}, psf.EKF()),
        (COUNTS, psf.IPLF()),
        (KNOWN_BY_DENSITY, None),
    ],
)
def test_the_gaussian_filter_that_leads_an_expensive_one(settings, filter):
    with pm.Model() as model:
        pm.HalfNormal("v")
        system = psf.StateSpaceModel(**settings)
        psf.StateSpace("d", system, psf.BootstrapPF(10), steps=[4, 5, 6], observed=np.ones(3))
    assert pilot_filters(model, takes_counts=True) == ({} if filter is None else {"d": filter})
    assert pilot_filters(model, takes_counts=False) == (
        {"d": filter} if filter == psf.EKF() else {}
    )


@pytest.mark.parametrize(
    ("tune", "least", "most"), [(0, 0, 0), (199, 0, 0), (200, 400, 2000), (500, 800, 3600)]
)
def test_a_search_costs_no_more_than_the_chains_of_a_short_run(
    narrow, expensive, evaluated, tune, least, most
):
    """Four chains with as many draws as warm-up make some 9.5 ``tune`` evaluations."""
    psf.sample_dram(10, tune, model=narrow, random_seed=1, progressbar=False)
    assert least <= sum(evaluated) <= most <= 10 * tune


@pytest.mark.parametrize(("is_expensive", "tune"), [(True, 1000), (False, 10)])
def test_cheap_models_and_long_warmups_have_the_complete_search(
    narrow, evaluated, monkeypatch, is_expensive, tune
):
    psf.find_starts(narrow, random_seed=1, progressbar=False)
    complete = sum(evaluated)
    evaluated.clear()
    monkeypatch.setattr(Target, "is_expensive", is_expensive)
    psf.sample_dram(10, tune, model=narrow, random_seed=1, progressbar=False)
    assert sum(evaluated) == pytest.approx(complete, rel=0.2)  # other random numbers
    assert complete > 5000


def test_chains_of_a_short_run_find_a_narrow_posterior(narrow, expensive):
    """From draws of the prior R-hat is above 1.5; the bound is that of four chains that agree."""
    tree = psf.sample_dram(200, 200, model=narrow, random_seed=1, progressbar=False)
    assert float(az.rhat(tree["posterior"].to_dataset())["mu"].max()) < 1.1
    mean, sd = tree["posterior"]["mu"].mean(("chain", "draw")), 0.1
    np.testing.assert_allclose(mean, [2.0, -5.0, 30.0], atol=5 * sd / np.sqrt(50))


def test_the_starts_of_a_seed_do_not_depend_on_the_number_of_draws(narrow, expensive):
    short, long = (
        psf.sample_dram(draws, 200, model=narrow, random_seed=1, progressbar=False)
        for draws in (10, 30)
    )
    drawn = long["posterior"]["mu"].isel(draw=slice(10))
    np.testing.assert_array_equal(short["posterior"]["mu"], drawn)
