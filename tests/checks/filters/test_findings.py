"""The verdicts on estimates that are made up: no filter is run."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.filters.bias import bias_at_draws, bias_elsewhere, is_settled
from pymc_statespace_filters.checks.filters.estimates import Comparison, Estimates
from pymc_statespace_filters.checks.filters.finding import FINE, OFF, UNDECIDED
from pymc_statespace_filters.checks.filters.low import low_at

PLAIN, GUIDED, MORE = psf.BootstrapPF(1000), psf.GuidedPF(100), psf.GuidedPF(400)


def noisy(filter, mean, scatter, n_seeds=4, n_points=20, seed=1):
    """Estimates that are unbiased for exp(mean)."""
    rng = np.random.default_rng(seed)
    centre = np.broadcast_to(np.reshape(mean, (-1, 1)), (n_points, 1)) - scatter**2 / 2
    return Estimates(filter, centre + scatter * rng.standard_normal((n_points, n_seeds)))


def exactly(filter, values):
    return Estimates(filter, np.broadcast_to(np.reshape(values, (-1, 1)), (20, 1)).copy())


def compared(checked, exact, plain, guided=()):
    return Comparison(checked, tuple(one for one in (exact, plain, *guided) if one is not None))


def draws(n=20, seed=2):
    return np.random.default_rng(seed).standard_normal((n, 2))


@pytest.mark.parametrize(
    ("shortfall", "scatter", "outcome"),
    [(0.0, 0.5, FINE), (8.0, 0.5, OFF), (0.0, 6.0, UNDECIDED), (8.0, 6.0, UNDECIDED)],
)
def test_a_guided_filter_that_looks_exact(shortfall, scatter, outcome):
    guided, more = noisy(GUIDED, -shortfall, 0.1, 8, seed=3), noisy(MORE, -shortfall, 0.05, 8)
    found = low_at(compared(guided, None, noisy(PLAIN, 0.0, scatter), (more,)), "at draws")
    assert found.outcome == outcome
    if outcome == OFF:
        assert "BootstrapPF(" in found.verdict
        assert found.statistic == pytest.approx(-8.0, abs=5 * found.se)
    if outcome == FINE:
        assert 0.1 < found.visible < 3.0


def test_more_guided_particles_prove_the_others_too_low_where_plain_ones_collapse():
    guided = noisy(GUIDED, -8.0, 0.1, 8, seed=3)
    found = compared(guided, None, noisy(PLAIN, 0.0, 6.0), (noisy(MORE, 0.0, 0.1, 8),))
    assert low_at(found, "at draws").outcome == OFF


@pytest.mark.parametrize("collapsed", [False, True])
def test_guided_filters_that_are_right_are_rarely_found_low(collapsed):
    """Of 200, at most 9: one test in ten thousand would fail at a rate of one per cent."""
    scatter = 5.0 if collapsed else 0.8
    found = [
        low_at(
            compared(
                noisy(GUIDED, 0.0, 0.8, 8, seed=i),
                None,
                noisy(PLAIN, 0.0, scatter, seed=1000 + i),
                (noisy(MORE, 0.0, 0.4, 8, seed=2000 + i),),
            ),
            "at draws",
        ).outcome
        for i in range(200)
    ]
    assert found.count(OFF) <= 9
    assert (found.count(UNDECIDED) > 150) == collapsed


@pytest.mark.parametrize(
    ("spread", "begin"),
    [(0.05, "EKF() is close to GridFilter(): "), (0.8, "no sign that EKF() is off: it is ")],
)
def test_a_filter_is_close_where_no_parameter_can_move_far(spread, begin):
    """A standard deviation of the difference bounds every shift."""
    lost = spread * np.random.default_rng(5).standard_normal(20)
    found = compared(exactly(psf.EKF(), lost), exactly(psf.GridFilter(), 0.0), None)
    row, *_ = bias_at_draws(found, draws(), ["a", "b"])
    assert row.outcome == FINE
    assert row.verdict.startswith(begin)
    assert "no parameter would move by more than" in row.verdict


def test_the_mean_difference_and_the_shift_of_a_parameter():
    at = draws(200)
    bias = -4.0 + 1.5 * at[:, 0]
    truth = np.random.default_rng(5).normal(0.0, 3.0, 200)
    plain = noisy(PLAIN, truth, 0.4, n_points=200)
    checked = Estimates(psf.EKF(), (truth + bias)[:, None])
    found = bias_at_draws(compared(checked, None, plain), at, ["a", "b"])
    by_name = {one.check: one for one in found}
    assert by_name["bias"].outcome == OFF
    assert by_name["bias"].statistic == pytest.approx(-4.0, abs=4 * by_name["bias"].se)
    # The posterior under the exact likelihood is tilted by the difference, its slope per sd.
    assert by_name["shift of a"].statistic == pytest.approx(-1.5, abs=0.3)
    assert by_name["shift of a"].outcome == OFF
    assert by_name["shift of b"].outcome == FINE
    assert "the posterior of a would move by -1." in by_name["bias"].verdict
    assert "this varies by 1." in by_name["bias"].verdict


def test_a_filter_that_is_right_passes():
    truth = np.linspace(-5.0, 0.0, 20)
    plain = noisy(PLAIN, truth, 0.4)
    found = compared(exactly(psf.EKF(), truth), None, plain)
    rows = bias_at_draws(found, draws(), ["a", "b"])
    assert [one.outcome for one in rows] == [FINE] * 3
    assert [one.outcome for one in bias_elsewhere(found, found)] == [FINE]


@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_no_shift_is_said_to_be_larger_than_the_difference_or_with_a_larger_error(spread):
    """Of parameters that are far outside at a draw, and of few draws."""
    at = draws(10)
    at[3] *= 30.0
    truth = np.zeros(10)
    lost = spread * np.random.default_rng(3).standard_normal(10)
    found = compared(
        Estimates(psf.EKF(), (truth - lost)[:, None]),
        Estimates(psf.GridFilter(), truth[:, None]),
        None,
    )
    bias, *moved = bias_at_draws(found, at, ["a", "b"])
    assert bias.outcome == FINE
    assert "±" not in bias.verdict.partition(" nats ")[2]
    assert max(one.visible for one in moved) < 4.0 * spread
    for one in moved:
        assert "would move by less than" in one.verdict


def test_more_draws_are_wanted_until_a_large_shift_would_be_seen():
    rng = np.random.default_rng(4)
    lost, exact = rng.standard_normal(200), np.zeros(200)
    settled = []
    for n in (10, 200):
        found = compared(
            Estimates(psf.EKF(), lost[:n, None]), Estimates(psf.GridFilter(), exact[:n, None]), None
        )
        settled.append(is_settled(bias_at_draws(found, draws(n), ["a", "b"])))
    assert settled == [False, True]


def test_a_filter_that_is_low_away_from_the_draws():
    plain = noisy(PLAIN, 0.0, 0.4)
    at_draws, others = (compared(exactly(psf.EKF(), low), None, plain) for low in (0.0, -9.0))
    assert bias_at_draws(at_draws, draws(), ["a", "b"])[0].outcome == FINE
    assert [one.outcome for one in bias_elsewhere(others, at_draws)] == [OFF]


@pytest.mark.parametrize(
    ("scatter", "outcomes"), [(0.1, (OFF, FINE, OFF)), (1.5, (OFF, UNDECIDED, UNDECIDED))]
)
def test_guided_particles_alone_decide_if_they_hardly_scatter(scatter, outcomes):
    """Others prove a filter too low, but not right."""
    collapsed, guided = noisy(PLAIN, -40.0, 7.0), noisy(GUIDED, 0.0, scatter, 8)
    for low, outcome in zip((-20.0, 0.0, 20.0), outcomes, strict=True):
        found = compared(exactly(psf.EKF(), low), None, collapsed, (guided,))
        row, *_ = bias_at_draws(found, draws(), ["a", "b"])
        assert row.outcome == outcome
        assert "GuidedPF(100)" in row.verdict
        if outcome == OFF:
            assert "its estimates are unbiased and scatter by" in row.verdict
        assert len(bias_elsewhere(found, found)) == (scatter < 1.0)


def test_an_exact_filter_is_the_reference():
    found = compared(exactly(psf.EKF(), -30.0), exactly(psf.GridFilter(), 0.0), None)
    row, *_ = bias_at_draws(found, draws(), ["a", "b"])
    assert (row.outcome, row.statistic) == (OFF, -30.0)
    assert "Use GridFilter()" in row.verdict
    guided = compared(noisy(GUIDED, -5.0, 0.1, 8), exactly(psf.GridFilter(), 0.0), None)
    assert low_at(guided, "at draws").outcome == OFF


@pytest.mark.parametrize("n_lost", [1, 20])
def test_no_likelihood_where_another_filter_has_one(n_lost):
    lost = np.where(np.arange(20) < n_lost, -np.inf, 0.0)
    exact, plain = exactly(psf.GridFilter(), 0.0), noisy(PLAIN, 0.0, 0.4)
    for reference in ((exact, None), (None, plain)):
        found = compared(exactly(psf.EKF(), lost), *reference)
        (row,) = bias_at_draws(found, draws(), ["a", "b"])
        (elsewhere,) = bias_elsewhere(found, compared(exactly(psf.EKF(), 0.0), *reference))
        low = low_at(found._replace(checked=noisy(GUIDED, lost, 0.1, 8)), "at draws")
        assert [one.outcome for one in (row, elsewhere, low)] == [OFF] * 3
        name = "GridFilter()" if reference[0] else "BootstrapPF(1000)"
        assert f"zero at {n_lost} of 20 points, and not zero by {name}. Use " in row.verdict


def test_the_reason_of_indecision_is_how_much_filters_scatter():
    noise, exact = noisy(GUIDED, 40.0, 6.0, 8), exactly(psf.GridFilter(), 0.0)
    own = low_at(compared(noise, exact, None), "at draws")
    assert own.outcome == UNDECIDED
    assert "at draws: GuidedPF(100) scatters by" in own.verdict
    quiet = noisy(GUIDED, 0.0, 0.1, 8)
    plain = low_at(compared(quiet, None, noisy(PLAIN, 0.0, 6.0)), "at draws")
    assert "and BootstrapPF(1000) scatters by" in plain.verdict


@pytest.mark.parametrize(("scatter", "named"), [(0.5, "BootstrapPF"), (1.9, "GuidedPF(20)")])
def test_a_guided_filter_is_recommended_where_plain_particles_cost_more(scatter, named):
    """1000 plain ones with a variance of the log of 0.25 are like 140 that suit a chain."""
    guided = noisy(psf.GuidedPF(20), 0.0, 0.1, 8)
    plain = noisy(PLAIN, 0.0, scatter, 200)
    found = compared(exactly(psf.EKF(), -9.0), None, plain, (guided,))
    (row, *_) = bias_at_draws(found, draws(), ["a", "b"])
    assert f"Use {named}" in row.verdict
