"""An SEIR epidemic by counts, held to an exact simulation event by event."""

import numpy as np
import pymc as pm
import pytest
from scipy.stats import chisquare, norm

import pymc_statespace_filters as psf
from tests.references.epidemic import Epidemic, simulate


def epidemic_system(epidemic, dt):
    """Compartments S, E and I, cases of a week; the exits of a compartment compete."""
    population, latency, recovery = epidemic.population, epidemic.latency, epidemic.recovery
    turnover, imported = epidemic.turnover, epidemic.imported

    def events(x, infection):
        S, E, I, _ = x  # noqa: E741
        births = pm.Poisson.dist(turnover * population * dt)
        rate = infection * (I + imported) / population
        return [
            births,
            *psf.compartments.euler_multinomial(S, [rate, turnover], dt),
            *psf.compartments.euler_multinomial(E, [latency, turnover], dt),
            *psf.compartments.euler_multinomial(I, [recovery, turnover], dt),
        ]

    def step(x, q):
        S, E, I, cases = x  # noqa: E741
        births, infected, s_died, emerged, e_died, recovered, i_died = q
        return [
            S + births - infected - s_died,
            E + infected - emerged - e_died,
            I + emerged - recovered - i_died,
            cases + recovered,
        ]

    return psf.StateSpaceModel(
        transition=step,
        process_dist=events,
        dt=dt,
        observation_dist=lambda x, reported: [pm.Poisson.dist(reported * x[3] + 1e-3)],
        initial_mean=[*epidemic.start, 0.0],
        initial_cov=np.zeros((4, 4)),
        states=["S", "E", "I", "cases"],
        accumulators=["cases"],
    )


def weekly_cases(epidemic, n_weeks, n_paths, dt):
    system, steps = epidemic_system(epidemic, dt), np.arange(1, n_weeks + 1) * round(7 / dt)
    given = {"infection": epidemic.infection, "reported": 0.5}

    def cases(seed):
        run = psf.simulate(system, given, steps=steps, random_seed=seed)
        return run["states"].sel(state="cases").values[steps]

    return np.stack([cases(seed + round(1e6 * dt)) for seed in range(n_paths)])


def compared(epidemic, n_weeks, n_paths, dt):
    """Standardised differences of means and of standard deviations of every week's cases.

    Means are extrapolated to steps of length zero, because their error is proportional to the step.
    """
    exact = simulate(epidemic, n_weeks, n_paths, 1)
    long, short = (weekly_cases(epidemic, n_weeks, n_paths, step) for step in (2 * dt, dt))
    variance = (4 * short.var(0) + long.var(0) + exact.var(0)) / n_paths
    mean = (2 * short.mean(0) - long.mean(0) - exact.mean(0)) / np.sqrt(variance)
    spread = np.log(short.std(0) / exact.std(0)) * np.sqrt(n_paths)
    return mean, spread


@pytest.mark.parametrize(
    ("population", "n_weeks", "n_paths"),
    [
        (1e3, 12, 500),
        pytest.param(1e4, 400, 200, marks=pytest.mark.slow),
        pytest.param(1e5, 400, 150, marks=pytest.mark.slow),
        pytest.param(1e7, 100, 40, marks=pytest.mark.slow),
    ],
)
def test_moments_of_cases(population, n_weeks, n_paths):
    """Steps of three hours and of an hour and a half, extrapolated.

    Wrong once in 1000 runs of a right simulation: a bound for the largest of all weeks.
    """
    epidemic = Epidemic(population, infection=3.0)
    mean, spread = compared(epidemic, n_weeks, n_paths, dt=1 / 16)
    bound = norm.isf(0.0005 / (2 * n_weeks))
    assert np.abs(mean).max() < bound
    # The logarithm of a standard deviation of n normals has the standard error 1 / sqrt(2 n);
    # cases of small numbers are a little wider.
    assert np.abs(spread).max() < 1.5 * bound


N_REPLICATIONS, N_RANKS = 100, 20


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
def test_ranks_of_the_posterior_are_uniform():
    """Simulation-based calibration: the truth has any rank among independent draws.

    Two chi-squared tests, each wrong once in 200 runs of a right sampler.
    """
    epidemic = Epidemic(1e3, infection=3.0, susceptible=0.3, exposed=0.01, infectious=0.01)
    system, steps = epidemic_system(epidemic, 1.0), np.arange(7, 106, 7)
    with pm.Model() as model:
        pm.LogNormal("infection", np.log(2.0), 0.3)
        pm.Beta("reported", 6.0, 6.0)
        data = pm.Data("data", np.zeros((steps.size, 1)))
        psf.StateSpace("cases", system, psf.BootstrapPF(300), steps=steps, observed=data)
    rng = np.random.default_rng(0)
    ranks = {"infection": [], "reported": []}
    for replication in range(N_REPLICATIONS):
        truth = {"infection": rng.lognormal(np.log(2.0), 0.3), "reported": rng.beta(6.0, 6.0)}
        run = psf.simulate(system, truth, steps=steps, random_seed=replication)
        pm.set_data({"data": run["observations"].values}, model=model)
        chains = psf.sample_dram(
            1000, 500, chains=2, cores=2, model=model, random_seed=replication,
            progressbar=False, compute_convergence_checks=False,
        )  # fmt: skip
        for name, found in ranks.items():
            draws = chains["posterior"][name].values.ravel()
            thinned = draws[:: len(draws) // (N_RANKS - 1)][: N_RANKS - 1]
            found.append(np.sum(thinned < truth[name]))
    for name, found in ranks.items():
        counts = np.bincount(np.array(found) // 2, minlength=N_RANKS // 2)
        assert chisquare(counts).pvalue > 0.005, (name, counts)
