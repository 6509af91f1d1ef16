"""Sums that begin anew where they were seen: a monthly index beside the sum of a quarter.

The reference is the dense Gaussian law of index and sums, in which nothing is reset: a sum is that
of the steps since the last row in which it was seen.
"""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import multivariate_normal

import pymc_statespace_filters as psf
from tests.states.models import posterior

pytestmark = pytest.mark.usefixtures("interpreted")

A, R = 0.8, np.diag([0.1, 0.2])
STEPS = np.array([1, 2, 3, 4, 6, 7])
NAN = np.nan
# The sum is seen in the third and the fifth row; the fourth is wholly missing.
DATA = np.array([[0.3, NAN], [0.1, NAN], [0.5, 0.9], [NAN, NAN], [0.2, 1.1], [0.4, NAN]])
FUTURE = np.array([9, 10])


def index_and_sum(**settings):
    return psf.StateSpaceModel(
        lambda x, q, a: [a * x[0] + 0.5 * q[0], x[1] + a * x[0] + 0.5 * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0], x[1]],
        observation_noise=R,
        initial_mean=[0.2, 0.1],
        initial_cov=np.diag([0.5, 0.3]),
        states=["index", "sum"],
        accumulators=["sum"],
        **settings,
    )


SYSTEM = index_and_sum()


def law(rows, seen_at):
    """Mean (2 R,) and covariance of index and sum at ``rows``, given where the sum was seen."""
    n = max(rows)
    start = np.linalg.cholesky(np.diag([0.5, 0.3]))
    columns, total = [], 2 + n
    for c in np.vstack([np.zeros(total), np.eye(total)]):
        index = [start[0, 0] * c[0] + 0.2 * (not c.any())]
        for q in c[2:]:
            index.append(A * index[-1] + 0.5 * q)
        path = []
        for k in rows:
            since = max([s for s in seen_at if s < k], default=0)
            first = (start[1, 1] * c[1] + 0.1 * (not c.any())) * (not [s for s in seen_at if s < k])
            path += [index[k], first + sum(index[since + 1 : k + 1])]
        columns.append(path)
    gain = np.array(columns[1:]).T
    return np.array(columns[0]), gain @ gain.T


def density(steps, data, seen_at):
    known = np.isfinite(data).ravel()
    mean, cov = law(steps, seen_at)
    cov = cov + np.kron(np.eye(len(steps)), R)
    return multivariate_normal.logpdf(data.ravel()[known], mean[known], cov[np.ix_(known, known)])


EXACT = density(STEPS, DATA, [3, 6])


def model_of(filter, data=DATA, steps=STEPS, **settings):
    with pm.Model() as model:
        pm.Normal("a", A)
        psf.StateSpace("d", SYSTEM, filter, steps=steps, observed=data, **settings)
    return model


@pytest.mark.parametrize("filter", [psf.EKF(), psf.UKF(), psf.IPLF()])
def test_a_sum_goes_on_until_it_is_seen(filter):
    terms = psf.log_likelihood(SYSTEM, filter, {"a": A}, DATA, steps=STEPS)
    np.testing.assert_allclose(terms.sum(), EXACT, rtol=1e-10)
    by_row = psf.log_likelihood(index_and_sum(resets="row"), filter, {"a": A}, DATA, steps=STEPS)
    np.testing.assert_allclose(by_row.sum(), density(STEPS, DATA, STEPS), rtol=1e-10)


def test_particles_agree():
    found = [
        psf.log_likelihood(SYSTEM, filter, {"a": A}, DATA, steps=STEPS, seed=1).sum()
        for filter in (psf.GuidedPF(20), psf.BootstrapPF(100_000))
    ]
    np.testing.assert_allclose(found[0], EXACT, rtol=1e-9)
    assert abs(found[1] - EXACT) < 0.05


def test_a_run_goes_on_from_every_row():
    """Also behind a row in which the sum was not seen, and in two records of a panel."""
    for cut in range(1, STEPS.size):
        first = psf.run_filter(SYSTEM, psf.EKF(), {"a": A}, DATA[:cut], steps=STEPS[:cut])
        second = psf.run_filter(
            SYSTEM, psf.EKF(), {"a": A}, DATA[cut:], steps=STEPS[cut:], state=first
        )
        parts = [run["log_likelihood"].sum() for run in (first, second)]
        np.testing.assert_allclose(sum(parts), EXACT, rtol=1e-10)


def test_a_panel_its_states_and_its_gradient():
    """Records that end where the next one begins, one of a single row at step 0."""
    labels = np.array([0] * 3 + [1] + [2] * 6)
    steps, data = np.r_[STEPS[:3], 0, STEPS], np.vstack([DATA[:3], [[0.1, NAN]], DATA])
    exact = density(STEPS[:3], DATA[:3], [3]) + density([0], data[3:4], []) + EXACT
    model = model_of(psf.EKF(), data, steps, panel=labels)
    logp = model.compile_logp(sum=False)({"a": A})
    np.testing.assert_allclose(logp[-1].sum(), exact, rtol=1e-10)
    terms = psf.log_likelihood(SYSTEM, psf.EKF(), {"a": A}, data, steps=steps, panel=labels)
    np.testing.assert_allclose(terms.sum(), exact, rtol=1e-10)
    gradient, whole = model.compile_dlogp(), model.compile_logp()
    slope = (whole({"a": A + 1e-5}) - whole({"a": A - 1e-5})) / 2e-5
    np.testing.assert_allclose(gradient({"a": A}), slope, rtol=1e-6)


def test_states_and_forecasts_go_on_with_the_sum():
    draws, model = posterior(a=np.full((1, 2), A)), model_of(psf.EKF())
    known = np.isfinite(DATA).ravel()
    mean, cov = law(np.r_[STEPS, FUTURE], [3, 6, 9])
    spread = cov[:12, :12][np.ix_(known, known)] + np.kron(np.eye(6), R)[np.ix_(known, known)]
    gain = np.linalg.solve(spread, cov[:12][known]).T
    given = mean + gain @ (DATA.ravel()[known] - mean[:12][known])
    found = psf.smoothed_states(draws, model, random_seed=1)["smoothed_states"]
    np.testing.assert_allclose(found["d_mean"].values[0, 0].ravel(), given[:12], rtol=1e-8)
    many = posterior(a=np.full((2, 3000), A))
    psf.forecast(many, model, steps=FUTURE, random_seed=1, progressbar=False)
    path = many["predictions"]["d_states"].values.reshape(6000, 4)
    sd = np.sqrt(np.diagonal(cov - gain @ cov[:12][known])[12:])
    z = (path.mean(axis=0) - given[12:]) / sd * np.sqrt(6000)
    assert np.abs(z).max() < 4.0  # 2.5e-4 of right implementations fail
    run = psf.free_run(draws, model, random_seed=1)["free_run"]["d_states"].values[0, 0]
    np.testing.assert_allclose(run.ravel(), law(STEPS, [3, 6])[0], rtol=1e-10)


def test_draws_have_the_gaps_of_the_data_and_simulations_none():
    with model_of(psf.EKF()):
        drawn = pm.sample_posterior_predictive(
            posterior(a=np.full((2, 3000), A)), random_seed=1, progressbar=False
        )["posterior_predictive"]["d"]
    mean, cov = law(STEPS, [3, 6])
    sd = np.sqrt(np.diagonal(cov) + np.tile(R.diagonal(), 6))
    found = drawn.values.reshape(6000, 12)
    assert np.abs((found.mean(axis=0) - mean) / sd * np.sqrt(6000)).max() < 4.0
    assert np.abs(np.log(found.std(axis=0) / sd) * np.sqrt(12000)).max() < 4.0
    still = psf.simulate(SYSTEM, {"a": A}, steps=STEPS, noise=False)["observations"].values
    np.testing.assert_allclose(still.ravel(), law(STEPS, STEPS)[0], rtol=1e-10)


def test_data_that_a_model_is_given_later():
    """As shared data, which change, and by pm.observe."""
    shared = pytensor.shared(DATA)
    logp = model_of(psf.EKF(), shared).compile_logp(sum=False)
    np.testing.assert_allclose(logp({"a": A})[-1].sum(), EXACT, rtol=1e-10)
    other = DATA.copy()
    other[1, 1] = 0.5
    shared.set_value(other)
    exact = density(STEPS, other, [2, 3, 6])
    np.testing.assert_allclose(logp({"a": A})[-1].sum(), exact, rtol=1e-10)
    later = pm.observe(model_of(psf.EKF(), None), {"d": DATA})
    np.testing.assert_allclose(later.compile_logp(sum=False)({"a": A})[-1].sum(), EXACT, rtol=1e-10)


def test_which_observables_read_a_sum():
    """Of matrices, distributions, and a density of all observables together."""
    weights = np.array([[1.0, 0.0, 0.0], [0.3, 1.0, 0.0]])
    settings = dict(
        transition=lambda x, q: [x[0] + q[0], x[1] + x[0], x[2] + x[0]], process_noise=[[1.0]],
        initial_mean=[0.0, 0.0, 0.0], initial_cov=np.eye(3), accumulators=["x2", "x1"],
    )  # fmt: skip
    whole = dict(observation=lambda x: weights @ x, observation_noise=np.eye(2))
    dists = dict(observation_dist=lambda x: [pm.Poisson.dist(abs(x[1])), pm.Normal.dist(0, x[2])])
    nested = dict(
        observation_dist=lambda x: [
            pm.Mixture.dist([0.3, 0.7], pm.Poisson.dist(abs(pt.stack([1.0, x[1]])))),
            pm.Censored.dist(pm.Normal.dist(x[2], 1.0), lower=None, upper=5.0),
        ]
    )
    joint = dict(observation_logp=lambda x, d: -((x[1] + d[0]) ** 2), observables=["a", "b"])
    # An accumulator that no observable reads, such as x2 of the matrix, ends with any of them.
    for seen, expected in (
        (whole, [[1, 0], [1, 1]]),
        (dists, [[0, 1], [1, 0]]),
        (nested, [[0, 1], [1, 0]]),
        (joint, [[1, 1], [1, 1]]),
    ):
        readers = psf.StateSpaceModel(**settings, **seen).readers
        assert readers.tolist() == expected


def test_a_rule_that_was_not_named_is_asked_for_where_single_values_are_missing():
    """Not where most values are missing, as those of a sum of several rows are."""
    steps, few = np.arange(1, 7), np.column_stack([np.zeros(6), [1.0, 2.0, NAN, 1.0, 2.0, 3.0]])
    with pytest.warns(psf.errors.ModelWarning, match=r"^1 of 6 rows have no value of 'sum', which"):
        psf.log_likelihood(SYSTEM, psf.EKF(), {"a": A}, few, steps=steps)
    for resets in ("seen", "row"):
        psf.log_likelihood(index_and_sum(resets=resets), psf.EKF(), {"a": A}, few, steps=steps)
    with pytest.raises(psf.errors.ModelError, match="resets must be 'seen' or 'row', got 'all'"):
        index_and_sum(resets="all")
