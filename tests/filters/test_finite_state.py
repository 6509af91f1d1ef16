"""FiniteStateFilter against all paths written out, differences, and itself elsewhere."""

import itertools

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from numba import njit
from scipy.linalg import expm
from scipy.stats import norm, poisson

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.catalog import exact_filter
from pymc_statespace_filters.filters.markov_chain.backward import _add
from pymc_statespace_filters.filters.outcomes import Failure
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.signatures import PANEL
from pymc_statespace_filters.ops.states import Predictions, States
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record

pytestmark = pytest.mark.usefixtures("interpreted")

# A regime that remembers the one before, is pushed by an input, and is seen by two sensors.
SWITCH = psf.StateSpaceModel(
    transition=lambda x, q: [q[0], x[0]],
    process_dist=lambda x, u, up, down: [
        pm.Bernoulli.dist(pm.math.sigmoid(pt.switch(pt.eq(x[0], 0), up, -down) + 0.5 * u[0]))
    ],
    observation=lambda x, level: [level * x[0] + 0.3 * x[1], x[0] - x[1]],
    observation_noise=lambda s: [[s**2, 0.05], [0.05, 0.3]],
    initial_dist=lambda first: [pm.Bernoulli.dist(first), 0],
    states=["regime", "before"],
    inputs=["push"],
)
GIVEN = {"up": -0.4, "down": 0.3, "level": 1.2, "s": 0.6, "first": 0.3}
RECORD = {
    "observed": np.array([[0.2, 0.1], [1.1, np.nan], [np.nan, np.nan], [1.4, -0.7], [-0.3, 0.2]]),
    "steps": np.array([0, 1, 3, 4, 7]),
    "inputs": np.array([0.3, -0.5, 1.0, 0.2, -0.1, 0.7, 0.4, 0.0]),
}


def switch_paths(up, down, level, s, first, observed, steps, inputs):
    """All paths of the regime, and log p(path, data) of each."""
    cov = np.array([[s**2, 0.05], [0.05, 0.3]])
    paths = np.array(list(itertools.product(range(2), repeat=steps[-1] + 1)))
    log_p = np.log(np.where(paths[:, 0] == 1, first, 1 - first))
    for k in range(steps[-1]):
        logit = np.where(paths[:, k] == 0, up, -down) + 0.5 * inputs[k]
        log_p -= np.log1p(np.exp(np.where(paths[:, k + 1] == 1, -logit, logit)))
    before = np.column_stack([np.zeros(len(paths)), paths[:, :-1]])
    for k, d in zip(steps, observed, strict=True):
        seen = ~np.isnan(d)
        if seen.any():
            mean = np.stack([level * paths[:, k] + 0.3 * before[:, k], paths[:, k] - before[:, k]])
            error, part = (d[:, None] - mean)[seen], cov[np.ix_(seen, seen)]
            quadratic = np.einsum("ai,ab,bi->i", error, np.linalg.inv(part), error)
            log_p -= 0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * part)[1])
    return paths, log_p


# A machine that wears out in three stages, and never recovers: moves of probability zero.
WEAR = psf.StateSpaceModel(
    transition=lambda x, q: [pt.minimum(x[0] + q[0], 2.0)],
    process_dist=lambda x, p: [pm.Bernoulli.dist(pt.switch(x[0] < 2, p[0] * (1 + x[0]), 0.0))],
    observation_dist=lambda x, rate: [pm.Poisson.dist(0.1 + rate * x[0])],
    initial_mean=[0.0],
    initial_cov=[[0.0]],
    shapes={"p": (1,)},
    states=["stage"],
)
WORN = {"p": [0.2], "rate": 1.5}
COUNTS = {"observed": np.array([0.0, np.nan, 1.0, 2.0, 0.0, 5.0]), "steps": [0, 1, 2, 4, 5, 8]}


def wear_paths(p, rate, observed, steps):
    """All paths of the stage, and the probability of each and the data."""
    paths = np.array(list(itertools.product(range(3), repeat=steps[-1] + 1)))
    ups = np.array([p[0], 2 * p[0], 0.0])
    moves = np.diag(1 - ups) + np.diag(ups[:2], 1)
    probability = (paths[:, 0] == 0) * moves[paths[:, :-1], paths[:, 1:]].prod(axis=1)
    for k, d in zip(steps, observed, strict=True):
        if not np.isnan(d):
            probability *= poisson.pmf(d, 0.1 + rate * np.arange(3))[paths[:, k]]
    return paths, probability


def arguments_of(system, params, record):
    """The arguments of a likelihood."""
    rows = read_record(system, GivenRecord(**record)).arguments
    return (flat_parameters(system, params), *rows, 0)


def gradient(system, filter, params, record, weights=None):
    """A weighted sum of terms and its derivative."""
    arguments = arguments_of(system, params, record)
    likelihood = LogLikelihood(system, filter)
    terms, _ = evaluator(likelihood)(*arguments)
    weights = 1.0 + 0.1 * np.arange(terms.size) if weights is None else weights
    (slope,) = evaluator(likelihood.gradient())(*arguments, weights)
    return terms @ weights, slope


def by_differences(system, filter, params, record):
    """The same derivative, by central differences of fourth order."""
    theta, *row = arguments_of(system, params, record)
    run, found = evaluator(LogLikelihood(system, filter)), []
    for i in range(theta.size):

        def value(step, i=i):
            terms, _ = run(theta + step * np.eye(theta.size)[i], *row)
            return terms @ (1.0 + 0.1 * np.arange(terms.size))

        h = 1e-3
        slopes = [(value(s) - value(-s)) / (2 * s) for s in (h, 2 * h)]
        found.append((4 * slopes[0] - slopes[1]) / 3)
    return np.array(found)


def test_all_paths_of_a_regime_with_memory():
    """A missing component, a missing row, steps between rows, and inputs."""
    terms = psf.log_likelihood(SWITCH, psf.FiniteStateFilter(), GIVEN, **RECORD)
    _, log_p = switch_paths(**GIVEN, **RECORD)
    assert terms[2] == 0.0
    np.testing.assert_allclose(terms.sum(), np.log(np.exp(log_p).sum()), rtol=1e-12)


def test_all_paths_through_impossible_moves():
    """And a count that is missing."""
    terms = psf.log_likelihood(WEAR, psf.FiniteStateFilter(), WORN, **COUNTS)
    _, probability = wear_paths(**WORN, **COUNTS)
    np.testing.assert_allclose(terms.sum(), np.log(probability.sum()), rtol=1e-12)


@pytest.mark.parametrize(
    ("system", "given", "record"), [(SWITCH, GIVEN, RECORD), (WEAR, WORN, COUNTS)]
)
def test_gradient_is_that_of_differences(system, given, record):
    """With moves of probability zero, missing rows and inputs."""
    filter = psf.FiniteStateFilter()
    _, found = gradient(system, filter, given, record)
    expected = by_differences(system, filter, given, record)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_gradient_where_a_probability_is_zero():
    """One-sided: the derivative by a probability that is zero is that of the likelihood."""
    h = 1e-6
    record = COUNTS | {"observed": np.zeros(6)}
    _, (_, found) = gradient(WEAR, psf.FiniteStateFilter(), {"p": [0.0], "rate": 1.5}, record)
    value = [
        gradient(WEAR, psf.FiniteStateFilter(), {"p": [p], "rate": 1.5}, record)[0]
        for p in (0.0, h, 2 * h)
    ]
    np.testing.assert_allclose(found, (4 * value[1] - value[2] - 3 * value[0]) / (2 * h), rtol=1e-5)


def test_what_has_no_weight_has_no_derivative():
    """Though that of the log-density of an impossible observation is infinite."""

    @njit
    def added(derivatives, weights):
        theta_bar = np.ones(2)
        _add(np.array([1]), derivatives, weights, theta_bar)
        return theta_bar

    found = added(np.array([[np.inf, 2.0]]), np.array([0.0, 3.0]))
    np.testing.assert_array_equal(found, [1.0, 7.0])


def test_two_thousand_observations():
    """Terms and gradient stay finite and right."""
    rng = np.random.default_rng(3)
    record = {
        "observed": rng.normal(size=(2000, 2)), "steps": np.arange(2000), "inputs": np.zeros(2000),
    }  # fmt: skip
    filter = psf.FiniteStateFilter()
    _, found = gradient(SWITCH, filter, GIVEN, record)
    np.testing.assert_allclose(found, by_differences(SWITCH, filter, GIVEN, record), rtol=1e-6)


def states(moment, seeds, system=SWITCH, given=GIVEN, record=RECORD):
    """Mean, sd and draws of the states at all steps."""
    arguments = arguments_of(system, given, record)
    run = evaluator(States(system, psf.FiniteStateFilter(), moment))
    wanted = np.arange(record["steps"][-1] + 1)
    found = [run(*arguments, wanted, seed) for seed in seeds]
    return found[0][0], found[0][1], np.array([f[2] for f in found])


def test_smoothed_states_and_paths():
    """Probabilities are those of all paths, and so are the frequencies of paths that are drawn.

    The 4000 paths of 256 possible ones: chi-squared with the classes of fewer than 5 joined; fails
    once in 1000 seeds.
    """
    paths, log_p = switch_paths(**GIVEN, **RECORD)
    weights = np.exp(log_p - log_p.max())
    weights /= weights.sum()
    mean, sd, drawn = states("smoothed", range(4000))
    np.testing.assert_allclose(mean[:, 0], weights @ paths, rtol=1e-12)
    np.testing.assert_allclose(mean[1:, 1], mean[:-1, 0], rtol=1e-12)
    np.testing.assert_allclose(sd, np.sqrt(mean * (1 - mean)), rtol=1e-9, atol=1e-9)
    assert (drawn[:, 1:, 1] == drawn[:, :-1, 0]).all()
    numbers = drawn[:, :, 0] @ 2 ** np.arange(7, -1, -1)
    counts = np.bincount(numbers.astype(int), minlength=256)
    large = 4000 * weights > 5
    expected = np.append(4000 * weights[large], 4000 * weights[~large].sum())
    found = np.append(counts[large], counts[~large].sum())
    statistic = ((found - expected) ** 2 / expected).sum()
    assert abs(statistic - large.sum()) < 3.3 * np.sqrt(2 * large.sum())


def test_filtered_and_predicted_states():
    """Those of all paths, given the data up to a step and before it."""
    mean = {moment: states(moment, [0])[0] for moment in ("predicted", "filtered")}
    for k in range(8):
        for moment, last in (("predicted", k - 1), ("filtered", k)):
            hidden = RECORD["observed"].copy()
            hidden[RECORD["steps"] > last] = np.nan
            paths, log_p = switch_paths(**GIVEN, **RECORD | {"observed": hidden})
            weights = np.exp(log_p)
            expected = weights @ paths[:, k] / weights.sum()
            np.testing.assert_allclose(mean[moment][k, 0], expected, rtol=1e-12)


# Moves that depend on time, a sensor that depends on inputs and time, and a start between the
# states, to which nothing leads.
SEASON = psf.StateSpaceModel(
    transition=lambda x, q: [1.0 + q[0]],
    process_dist=lambda x, t, swing: [
        pm.Bernoulli.dist(pm.math.sigmoid(swing * pt.sin(t) + pt.switch(x[0] > 1, 0.7, -0.3)))
    ],
    observation=lambda x, u, t, level: [level * x[0] * u[0] + 0.2 * t],
    observation_noise=[[0.3]],
    initial_mean=[1.5],
    initial_cov=[[0.0]],
    inputs=["gain"],
    dt=0.5,
)
SWINGING = {"swing": 2.0, "level": 0.7}
SEASONS = {
    "observed": np.array([0.2, 1.0, 0.3, np.nan, -0.9]),
    "steps": np.array([0, 1, 3, 4, 6]),
    "inputs": np.array([1.0, 0.5, -0.3, 0.8, -1.1, 0.4, 1.3]),
    "t0": 0.9,
}


def season_paths(swing, level, observed, steps, inputs, t0):
    """All paths of the state, and log p(path, data) of each."""
    paths = np.array([(1.5, *path) for path in itertools.product((1, 2), repeat=steps[-1])])
    t, log_p = t0 + 0.5 * np.arange(steps[-1] + 1), np.zeros(len(paths))
    for k in range(steps[-1]):
        up = 1 / (1 + np.exp(-swing * np.sin(t[k]) - np.where(paths[:, k] > 1, 0.7, -0.3)))
        log_p += np.log(np.where(paths[:, k + 1] == 2, up, 1 - up))
    for k, d in zip(steps, observed, strict=True):
        if not np.isnan(d):
            log_p += norm.logpdf(d, level * paths[:, k] * inputs[k] + 0.2 * t[k], 0.3**0.5)
    return paths, log_p


def season_states(k, last):
    """The mean of the state at a step given the data until another one."""
    hidden = np.where(SEASONS["steps"] > last, np.nan, SEASONS["observed"])
    paths, log_p = season_paths(**SWINGING, **SEASONS | {"observed": hidden})
    return np.average(paths[:, k], weights=np.exp(log_p))


def test_moves_by_time_and_sensors_by_inputs():
    """Terms, their gradient, and states, where steps are not the numbers of rows."""
    filter = psf.FiniteStateFilter()
    terms = psf.log_likelihood(SEASON, filter, SWINGING, **SEASONS)
    _, log_p = season_paths(**SWINGING, **SEASONS)
    np.testing.assert_allclose(terms.sum(), np.logaddexp.reduce(log_p), rtol=1e-12)
    _, slope = gradient(SEASON, filter, SWINGING, SEASONS)
    expected = by_differences(SEASON, filter, SWINGING, SEASONS)
    np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-8)
    for moment, lag in (("predicted", -1), ("filtered", 0), ("smoothed", 6)):
        mean = states(moment, [0], SEASON, SWINGING, SEASONS)[0][:, 0]
        exact = [season_states(k, k + lag) for k in range(7)]
        np.testing.assert_allclose(mean, exact, rtol=1e-12)
    law = evaluator(Predictions(SEASON, filter))(*arguments_of(SEASON, SWINGING, SEASONS))[0]
    u, t = SEASONS["inputs"], 0.9 + 0.5 * SEASONS["steps"]
    exact = [0.7 * u[k] * season_states(k, k - 1) for k in SEASONS["steps"]] + 0.2 * t
    np.testing.assert_allclose(law[:, 0], exact, rtol=1e-12)


def test_draws_at_different_steps_are_independent():
    """Of filtered states, as they are not a path: five standard errors of their covariances."""
    _, _, drawn = states("filtered", range(1000))
    of_regime = drawn[:, [2, 3, 6], 0]
    covariance = np.cov(of_regime.T)
    assert (np.diag(covariance) > 0.05).all()
    assert (abs(covariance[np.triu_indices(3, 1)]) < 5 * 0.25 / 1000**0.5).all()


def test_run_shows_the_probability_of_every_state():
    """As particles, which are all joint values, and their weights."""
    run = psf.run_filter(SWITCH, psf.FiniteStateFilter(), GIVEN, at="steps", **RECORD)
    assert run["particles"].isel(time=3).values.tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    np.testing.assert_allclose(run["weights"].sum("particle"), 1.0)
    np.testing.assert_allclose(run["mean"].values, states("filtered", [0])[0], rtol=1e-12)
    weights, members = run["weights"].values[3], run["particles"].values[3]
    exact = np.cov(members.T, aweights=weights, bias=True)
    np.testing.assert_allclose(run["cov"].values[3], exact, atol=1e-12)


@pytest.mark.parametrize("at", ["observations", "steps"])
def test_a_run_goes_on(at):
    """The second row of the part behind is missing, as is half of the one before."""
    filter = psf.FiniteStateFilter()
    whole = psf.run_filter(SWITCH, filter, GIVEN, **RECORD, at=at)
    rows = {name: RECORD[name] for name in ("observed", "steps")}
    first = {name: values[:1] for name, values in rows.items()}
    before = psf.run_filter(SWITCH, filter, GIVEN, **first, inputs=RECORD["inputs"], at=at)
    behind = {name: values[1:] for name, values in rows.items()}
    after = psf.run_filter(
        SWITCH, filter, GIVEN, **behind, inputs=RECORD["inputs"], at=at, state=before
    )
    for name, dim in (("log_likelihood", "obs_time"), ("weights", "time"), ("mean", "time")):
        both = xr.concat([before[name], after[name]], dim)
        np.testing.assert_allclose(both, whole[name], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(after["filter_state"], whole["filter_state"], rtol=1e-13)
    assert "most_probable_path" not in after
    drawn = filter.law_of_state(
        compile_system(SWITCH), np.tile(whole["filter_state"], (4000, 1))
    ).drawn(np.random.default_rng(1))
    np.testing.assert_allclose(drawn.mean(axis=0), whole["mean"][-1], atol=0.032)  # 4 errors


@pytest.mark.parametrize("at", ["steps", "observations"])
def test_the_most_probable_path_is_that_of_all(at):
    """Where two paths are about as probable, the paths at single steps are another one."""
    paths, log_p = switch_paths(**GIVEN, **RECORD)
    rows = slice(None) if at == "steps" else RECORD["steps"]
    run = psf.run_filter(SWITCH, psf.FiniteStateFilter(), GIVEN, at=at, **RECORD)
    best = paths[np.argmax(log_p)]
    found = run["most_probable_path"].sel(state=["regime", "before"]).values
    assert found[:, 0].tolist() == best[rows].tolist()
    assert found[:, 1].tolist() == np.append(0, best[:-1])[rows].tolist()


def test_the_most_probable_path_where_moves_are_impossible():
    """Of two records, one of which fails."""
    observed = np.concatenate([COUNTS["observed"], [0.0, -1.0]])
    steps, panel = [*COUNTS["steps"], 0, 1], [*"aaaaaa", *"bb"]
    with pytest.warns(psf.errors.FilterWarning):
        run = psf.run_filter(
            WEAR, psf.FiniteStateFilter(), WORN, observed, steps=steps, panel=panel, at="steps"
        )
    paths, probability = wear_paths(**WORN, **COUNTS)
    found = run["most_probable_path"].values[:, 0]
    np.testing.assert_array_equal(found[:9], paths[probability.argmax()])
    assert np.isnan(found[9:]).all()


def test_panel_and_many_points():
    """Records and points have the terms and the gradient that they have alone."""
    filter = psf.FiniteStateFilter()
    points = {name: np.array([value, 0.9 * value]) for name, value in GIVEN.items()}
    terms = psf.log_likelihood(SWITCH, filter, points, **RECORD)
    other = {name: 0.9 * value for name, value in GIVEN.items()}
    alone = psf.log_likelihood(SWITCH, filter, other, **RECORD)
    np.testing.assert_allclose(terms[1], alone, rtol=1e-13)
    with pm.Model() as model:
        level = pm.Normal("level", shape=2)
        psf.StateSpace(
            "y", SWITCH, filter, params=GIVEN | {"level": level}, panel=["a"] * 5 + ["b"] * 5,
            observed=np.concatenate([RECORD["observed"]] * 2), steps=[*RECORD["steps"]] * 2,
            inputs=np.tile(RECORD["inputs"], (2, 1))[:, :, None],
        )  # fmt: skip
    point = {"level": np.array([1.2, 0.7])}
    each = [
        gradient(SWITCH, filter, GIVEN | {"level": v}, RECORD, weights=np.ones(5))
        for v in point["level"]
    ]
    value = model.compile_logp(vars=model.observed_RVs)(point)
    np.testing.assert_allclose(value, sum(alone for alone, _ in each), rtol=1e-12)
    found = model.compile_dlogp(vars=[level])(point) + point["level"]  # without the prior
    place = SWITCH.parameters.index("level")
    np.testing.assert_allclose(found, [slope[place] for _, slope in each], rtol=1e-12)


def test_failures_are_counted_with_their_row():
    """A count below zero, and a probability above one."""
    likelihood = evaluator(LogLikelihood(WEAR, psf.FiniteStateFilter()))
    impossible = COUNTS["observed"].copy()
    impossible[3] = -1.0
    for p, observed, failure, row in (
        (0.2, impossible, Failure.ZERO_DENSITY, 3),
        (0.7, COUNTS["observed"], Failure.INVALID_PROBABILITY, 0),
    ):
        record = COUNTS | {"observed": observed}
        terms, health = likelihood(*arguments_of(WEAR, WORN | {"p": [p]}, record))
        assert (Failure(int(health[1])), health[2]) == (failure, row)
        assert np.isneginf(terms[row:]).all()
        assert np.isfinite(terms[:row]).all()


def test_the_row_that_fails_in_a_panel():
    """Of all rows, behind a record that has a likelihood."""
    rows = np.column_stack([np.repeat([0, 1], 6), np.tile(COUNTS["steps"], 2), np.zeros(12)])
    observed = np.tile(COUNTS["observed"], 2)
    observed[9] = -1.0
    theta = np.tile(flat_parameters(WEAR, WORN), (2, 1))
    likelihood = evaluator(LogLikelihood(WEAR, psf.FiniteStateFilter(), PANEL))
    given = theta, rows.astype(np.int64), observed[:, None], np.zeros((0, 0)), 0.0, 0
    terms, health = likelihood(*given)
    assert (Failure(int(health[1])), health[2]) == (Failure.ZERO_DENSITY, 9)
    np.testing.assert_array_equal(np.isneginf(terms), np.arange(12) >= 9)


def test_densities_far_below_that_of_an_impossible_state():
    """The terms are those of the possible states, 5000 nats below another one's."""
    sure = {**GIVEN, "first": 0.0, "level": 100.0, "s": 1.0, "up": -900.0}
    record = {"observed": [[100.0, 1.0]], "steps": [0], "inputs": [0.0]}
    found = psf.log_likelihood(SWITCH, psf.FiniteStateFilter(), sure, **record)
    cov = np.array([[1.0, 0.05], [0.05, 0.3]])
    error = np.array([100.0, 1.0])
    expected = -0.5 * (error @ np.linalg.solve(cov, error) + np.linalg.slogdet(2 * np.pi * cov)[1])
    np.testing.assert_allclose(found, [expected], rtol=1e-12)


def test_laws_of_observations():
    """PIT values of `filter_diagnostics` are those of the mixture over the predicted states."""
    arguments = (
        flat_parameters(SWITCH, GIVEN),
        *read_record(SWITCH, GivenRecord(**RECORD)).arguments,
        0,
    )
    mean, _, below, _ = evaluator(Predictions(SWITCH, psf.FiniteStateFilter()))(*arguments)
    hidden = RECORD | {"observed": np.full((5, 2), np.nan)}
    paths, log_p = switch_paths(**GIVEN, **hidden)
    seen = GIVEN["level"] * paths[:, 0]
    np.testing.assert_allclose(mean[0, 0], np.exp(log_p) @ seen, rtol=1e-12)
    expected = np.exp(log_p) @ norm.cdf((0.2 - seen) / GIVEN["s"])
    np.testing.assert_allclose(np.exp(below[0, 0]), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transition": lambda x, q: [q[0], 0.5 * x[1] + x[0]]}, "'before' takes more than 1024"),
        ({"initial_dist": lambda: [pm.Normal.dist(), 0]}, "'regime' starts from a distribution"),
        ({"initial_dist": None, "process_dist": None, "transition": lambda x: x,
          "initial_mean": [0, 0], "initial_cov": np.zeros((2, 2))}, "and none is"),
    ],
)  # fmt: skip
def test_other_systems_are_refused(changes, message):
    """By name of the state and with the reason."""
    settings = {
        "transition": lambda x, q: [q[0], x[0]],
        "process_dist": lambda x: [pm.Bernoulli.dist(0.5)],
        "observation": lambda x: [x[0]],
        "observation_noise": [[1.0]],
        "initial_dist": lambda: [0, 0],
        "states": ["regime", "before"],
    }
    system = psf.StateSpaceModel(**settings | changes)
    with pytest.raises(ModelError, match=message):
        psf.log_likelihood(system, psf.FiniteStateFilter(), {}, [0.0])


def test_values_are_checked():
    """Numbers of values, sequences, names, and steps that leave them."""
    with pytest.raises(
        ModelError, match="values: those of 'regime' must be how many there are, at least 1"
    ):
        psf.FiniteStateFilter(values={"regime": 0})
    with pytest.raises(ModelError, match=r"values must name states of .*got 'phase'"):
        psf.log_likelihood(SWITCH, psf.FiniteStateFilter(values={"phase": 2}), GIVEN, **RECORD)
    with pytest.raises(ModelError, match="'regime' must stay within"):
        psf.log_likelihood(SWITCH, psf.FiniteStateFilter(values={"regime": 1}), GIVEN, **RECORD)
    declared = psf.FiniteStateFilter(values={"regime": [1, 0]})
    assert declared == psf.FiniteStateFilter(values={"regime": 2})
    terms = psf.log_likelihood(SWITCH, declared, GIVEN, **RECORD)
    plain = psf.log_likelihood(SWITCH, psf.FiniteStateFilter(), GIVEN, **RECORD)
    np.testing.assert_array_equal(terms, plain)


def test_a_choice_between_values_of_the_state_is_no_kink():
    """A choice by a parameter is one: NUTS is chosen by it."""
    filter = psf.FiniteStateFilter()
    assert filter.is_smooth_for(compile_system(SWITCH))
    assert filter.is_smooth_for(compile_system(WEAR))
    kinked = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]],
        process_dist=lambda x, p: [pm.Bernoulli.dist(pt.minimum(p, 0.5))],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=[[0.0]],
    )
    assert not filter.is_smooth_for(compile_system(kinked))


def test_it_is_recommended_where_another_filter_refuses():
    """As an exact one, and `check_filter` takes it as its witness."""
    with pytest.raises(ModelError, match=r"FiniteStateFilter\(\)"):
        psf.log_likelihood(WEAR, psf.GridFilter(), WORN, **COUNTS)
    found = exact_filter(compile_system(WEAR), without=psf.BootstrapPF(100))
    assert found == psf.FiniteStateFilter()


def test_a_chain_in_continuous_time_at_uneven_gaps():
    """Probabilities of a matrix exponential, by that of SciPy; and their gradient."""
    gaps, data = np.array([0.1, 5.0, 0.7]), np.array([0.1, 0.9, 1.2, -0.1])

    def law(x, u, a):
        generator = pt.stack([pt.stack([-a, a]), pt.stack([0.7 * a, -0.7 * a])])
        return [pm.Categorical.dist(p=pt.linalg.expm(generator * u[0])[pt.cast(x[0], "int64")])]

    system = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]], process_dist=law, observation=lambda x: [x[0]],
        observation_noise=[[0.25]], initial_dist=lambda: [pm.Bernoulli.dist(0.4)], inputs=["gap"],
    )  # fmt: skip

    def exact(a):
        total, weights = 0.0, np.array([0.6, 0.4])
        for j, d in enumerate(data):
            if j:
                weights = weights @ expm(a * gaps[j - 1] * np.array([[-1.0, 1.0], [0.7, -0.7]]))
            weights = weights * norm.pdf(d, [0.0, 1.0], 0.5)
            total, weights = total + np.log(weights.sum()), weights / weights.sum()
        return total

    with pm.Model() as model:
        pm.Flat("a")
        psf.StateSpace("d", system, psf.FiniteStateFilter(), steps=range(4), observed=data,
                       inputs=gaps)  # fmt: skip
    logp, slope = model.compile_logp(), model.compile_dlogp()
    np.testing.assert_allclose(logp({"a": 1.3}), exact(1.3), rtol=1e-12)
    difference = (exact(1.3 + 1e-5) - exact(1.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope({"a": 1.3}), difference, rtol=1e-7)
    assert psf.FiniteStateFilter().is_smooth_for(compile_system(system))
