"""`check_filter` on systems whose likelihood is known: linear ones, and those of one state."""

import json
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.filters import checks, estimates
from pymc_statespace_filters.checks.filters.checks import _is_relevant
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.filter_estimates import VariableAtPoints
from tests.systems import FREE, autoregression

pytestmark = pytest.mark.usefixtures("interpreted")

N = 40
SQUARE = autoregression(spread=0.5, observation=lambda x: [x[0] ** 2], observation_noise=0.04)
# With a second state that is seen by itself, so that no filter without noise or bias takes it.
SQUARE_AND_LINE = psf.StateSpaceModel(
    transition=lambda x, q, phi: [phi * x[0] + q[0], 0.8 * x[1] + q[1]],
    process_noise=np.diag([0.25, 0.5]),
    observation=lambda x: [x[0] ** 2, x[1]],
    observation_noise=np.diag([0.04, 0.3]),
    initial_mean=[0.0, 0.0],
    initial_cov=np.eye(2),
)

LEVEL = psf.StateSpaceModel(
    transition=lambda x, q, level: [level + q[0]],
    process_noise=[[0.01]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.01]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def record_of(system, **given):
    return psf.simulate(system, given, steps=range(N), random_seed=1)["observations"].values


def model_of(system, filter, observed, name="phi"):
    with pm.Model() as model:
        pm.Normal(name, 0.8, 0.3)
        psf.StateSpace("d", system, filter, steps=range(N), observed=observed)
    return model


def draws_of(name="phi", seed=1):
    rng = np.random.default_rng(seed)
    return az.from_dict({"posterior": {name: rng.normal(0.8, 0.05, (2, 100))}})


def exact_filters_left_out(monkeypatch):
    monkeypatch.setattr(estimates, "exact_filter", lambda system, *, without: None)


def test_exact_and_plain_filters_are_not_compared(monkeypatch):
    monkeypatch.setattr(checks, "compare", None)
    observed = record_of(FREE, a=0.8)
    for filter in (psf.EKF(), psf.IPLF(), psf.GuidedPF(10), psf.GridFilter(), psf.BootstrapPF(50)):
        idata = draws_of("a")
        table = psf.check_filter(idata, model_of(FREE, filter, observed, "a"))
        assert table["outcome"].tolist() == ["exact"]
        (stored,) = json.loads(idata.attrs["filter_check"]).values()
        assert stored["outcome"] == "exact"


def test_a_biased_filter_of_a_user_is_compared_though_its_class_is_one_of_plain_particles():
    @dataclass(frozen=True)
    class Biased(psf.BootstrapPF):
        unbiased: ClassVar[bool] = False

    model = model_of(FREE, Biased(500), record_of(FREE, a=0.8), "a")
    table = psf.check_filter(draws_of("a"), model, random_seed=1)
    assert "exact" not in table["outcome"].tolist()


def test_an_approximation_of_a_linear_system_differs_by_its_noise_from_kalman():
    observed = record_of(FREE, a=0.8)
    model = model_of(FREE, psf.EnKF(4000, likelihood="gaussian"), observed, "a")
    table = psf.check_filter(draws_of("a"), model, random_seed=1).set_index("check")
    assert table["outcome"].unique().tolist() == ["no sign"]
    assert abs(table.loc["bias", "statistic"]) < 0.5


def test_a_sensor_that_squares_is_compared_with_the_grid_filter():
    observed = record_of(SQUARE, phi=0.8)
    model, idata = model_of(SQUARE, psf.EKF(), observed), draws_of()
    table = psf.check_filter(idata, model, random_seed=1)
    bias = table.set_index("check").loc["bias"]
    at = idata["posterior"]["phi"].values.ravel()
    ekf, grid = (
        psf.log_likelihood(SQUARE, f, {"phi": at}, observed, steps=range(N)).sum(axis=-1)
        for f in (psf.EKF(), psf.GridFilter())
    )
    assert bias["statistic"] == pytest.approx((ekf - grid).mean(), abs=4.0 * bias["se"])
    assert bias["outcome"] == "off"
    assert "Use GridFilter()" in bias["verdict"]
    lines = repr(table).splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].split() == ["variable", "check", "statistic", "se", "visible", "outcome"]
    assert lines[1].split()[:2] == ["0", "d"]
    assert "".join(bias["verdict"].split()) in "".join(repr(table).split())
    assert "off" in idata.attrs["filter_check"]


def test_particles_find_the_same_difference_as_the_grid_filter(monkeypatch):
    observed = record_of(SQUARE, phi=0.8)
    model = model_of(SQUARE, psf.EKF(), observed)
    exact = psf.check_filter(draws_of(), model, random_seed=1).set_index("check").loc["bias"]
    exact_filters_left_out(monkeypatch)
    found = psf.check_filter(draws_of(), model, random_seed=1).set_index("check").loc["bias"]
    assert found["outcome"] == "off"
    assert "PF(" in found["verdict"]
    assert found["statistic"] == pytest.approx(exact["statistic"], abs=2.0)


def test_another_filter_in_place_of_the_models():
    observed = record_of(SQUARE_AND_LINE, phi=0.8)
    model, idata = model_of(SQUARE_AND_LINE, psf.EKF(), observed), draws_of()
    of_model = psf.check_filter(idata, model, random_seed=1).set_index("check")
    stored = idata.attrs["filter_check"]
    other = psf.check_filter(idata, model, filter=psf.BootstrapPF(1000), random_seed=1)
    assert of_model.loc["bias", "outcome"] == "off"
    assert of_model.loc["bias", "filter"] == "EKF()"
    assert other["outcome"].tolist() == ["exact"]
    assert idata.attrs["filter_check"] == stored


def test_a_doubt_goes_with_the_draws():
    """What `check_filter` stores, the diagnostics and the evidence repeat for the same filter."""
    observed = record_of(SQUARE, phi=0.8)
    model, idata = model_of(SQUARE, psf.EKF(), observed), draws_of()
    psf.check_filter(idata, model, random_seed=1)
    with pytest.warns(psf.errors.FilterWarning, match=r"EKF\(\) is \d+ ± .* nats below GridFilter"):
        psf.filter_diagnostics(idata, model, n_draws=4, random_seed=1, progressbar=False)
    with pytest.warns(
        psf.errors.EvidenceWarning, match=r"EKF\(\) is \d+ ± .* nats below GridFilter"
    ):
        found = psf.estimate_evidence(
            idata, model, estimators="bridge", random_seed=1, progressbar=False
        )
    assert "nats below GridFilter()" in found["bridge"].doubts
    with_another_filter = model_of(SQUARE, psf.GridFilter(), observed)
    assert checks.stored(idata, with_another_filter, "off") == []


def test_a_seed_fixes_the_numbers():
    observed = record_of(SQUARE_AND_LINE, phi=0.8)
    model = model_of(SQUARE_AND_LINE, psf.EKF(), observed)
    a, b = (psf.check_filter(draws_of(), model, n_draws=8, random_seed=3) for _ in range(2))
    assert a.equals(b)


def test_where_plain_particles_collapse_guided_ones_judge_an_approximation_but_not_themselves(
    monkeypatch,
):
    """A sensor so fine that few of a thousand particles see an observation."""
    fine = autoregression(
        spread=0.5, observation_noise=1e-8, observation=lambda x: [x[0] + 0.1 * x[0] ** 3]
    )
    observed = record_of(fine, phi=0.8)
    model, other = (model_of(fine, filter, observed) for filter in (psf.EKF(), psf.GuidedPF(50)))
    exact = psf.check_filter(draws_of(), model, n_draws=8, random_seed=1)
    exact_filters_left_out(monkeypatch)
    monkeypatch.setattr(estimates.Budget, "n_particles", lambda *_: 1000)
    found = psf.check_filter(draws_of(), model, n_draws=8, random_seed=1)
    assert "GridFilter" in exact["verdict"][0]
    assert "GuidedPF(100)" in found["verdict"][0]
    assert found["statistic"][0] == pytest.approx(exact["statistic"][0], abs=0.1)
    assert found["outcome"][0] == exact["outcome"][0] == "no sign"
    itself = psf.check_filter(draws_of(), other, n_draws=8, random_seed=1)
    assert itself["outcome"][0] == "undecided"
    assert "BootstrapPF(1000)" in itself["verdict"][0]


def test_an_exact_filter_that_is_slow_is_neither_awaited_nor_recommended(monkeypatch):
    """Nor does the time of compilation count: the first run decides as the second does."""
    monkeypatch.setattr(estimates, "_seconds", lambda variable, filter: 1.0)
    model = model_of(SQUARE, psf.EKF(), record_of(SQUARE, phi=0.8))
    table = psf.check_filter(draws_of(), model, random_seed=1)
    assert table["outcome"][0] == "off"
    assert "GridFilter" not in table["verdict"][0]


def test_without_time_to_compile_a_filter_the_check_is_undecided(monkeypatch):
    monkeypatch.setattr(VariableAtPoints, "is_compiled", lambda variable, filter: False)
    model, rng = model_of(SQUARE, psf.EKF(), record_of(SQUARE, phi=0.8)), np.random.default_rng(1)
    found = checks.check_at_end(draws_of(), model, None, 10.0, rng)
    assert found["d"]["outcome"] == "undecided"
    assert "a filter to compare it with is not compiled yet" in found["d"]["verdict"]
    # A tenth of this is enough for plain particles, not for a grid or guided ones.
    found = checks.check_at_end(draws_of(), model, None, 100.0, rng)
    assert found["d"]["outcome"] == "off"
    assert "BootstrapPF(" in found["d"]["verdict"]


def test_more_draws_are_compared_until_they_are_enough(monkeypatch):
    judge, numbers = checks.bias_at_draws, []

    def counted(found, x, names):
        numbers.append(len(x))
        assert len(found.checked.logs) == len(x)
        return judge(found, x, names)

    monkeypatch.setattr(checks, "bias_at_draws", counted)
    monkeypatch.setattr(checks, "is_settled", lambda findings: False)
    psf.check_filter(draws_of(), model_of(SQUARE, psf.EKF(), record_of(SQUARE, phi=0.8)))
    assert numbers == [10, 40, 160]


def test_some_points_are_evaluated_however_little_time_there_is(monkeypatch):
    monkeypatch.setattr(estimates.Budget, "is_spent", True)
    model = model_of(SQUARE, psf.EKF(), record_of(SQUARE, phi=0.8))
    verdict = psf.check_filter(draws_of(), model, random_seed=1)["verdict"][0]
    assert "at draws" in verdict
    assert "nan" not in verdict


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_draws": 7}, "n_draws must be an integer of at least 8, got 7"),
        ({"filter": "EKF"}, "filter must be a filter"),
        ({"filter": psf.GridFilter()}, "GridFilter"),
        ({"random_seed": "x"}, "random_seed"),
    ],
)
def test_wrong_arguments_are_named(changes, message):
    observed = np.zeros((N, 2))
    model = model_of(SQUARE_AND_LINE, psf.EKF(), observed)
    with pytest.raises(ModelError, match=message):
        psf.check_filter(draws_of(), model, **changes)


def test_a_model_without_such_a_variable_is_refused():
    with pm.Model() as model:
        pm.Normal("phi")
    with pytest.raises(ModelError, match="observed StateSpace variable"):
        psf.check_filter(draws_of(), model)


def test_which_other_points_the_posterior_would_hold():
    """In sixty dimensions most draws of the prior are far too unlikely, and none is by its volume.

    The evidence is known: the level is the sum of the variables, over the root of their number.
    """
    with pm.Model() as model:
        theta = pm.Normal("theta", shape=60)
        level = theta.sum() / np.sqrt(60)
        psf.StateSpace("d", LEVEL, psf.EKF(), steps=[1], observed=[2.0], params={"level": level})
    rng, variance = np.random.default_rng(1), 0.02  # of the data

    def posterior(theta):
        """Draws of the prior, of which the level alone is as given the data."""
        gain = 1 / (1 + variance)
        new = 2.0 * gain + np.sqrt(variance * gain) * rng.normal(size=len(theta))
        return theta + (new - theta.sum(axis=1) / np.sqrt(60))[:, None] / np.sqrt(60)

    draws, prior = posterior(rng.normal(size=(2000, 60))), rng.normal(size=(200, 60))

    def exact(theta):
        log_likelihood = norm.logpdf(2.0, theta.sum(axis=1) / np.sqrt(60), np.sqrt(variance))
        return theta, SimpleNamespace(highest=log_likelihood)

    evidence = norm.logpdf(2.0, 0, np.sqrt(1 + variance))
    far = 30.0 * np.ones((1, 60))  # beyond the draws and without likelihood
    points = np.concatenate([prior, draws.mean(axis=0) + 2 * (draws[:5] - draws.mean(axis=0)), far])
    factors = np.repeat([np.inf, 2.0, 3.0], [200, 5, 1])
    found = _is_relevant(model, "d", draws, exact(draws[:40]), exact(points), factors)
    weight = exact(prior)[1].highest - evidence
    clear = abs(weight + 3.0) > 1.5  # of the estimate of the evidence
    assert 0 < (weight[clear] > -3.0).sum() < 100
    np.testing.assert_array_equal(found[:200][clear], weight[clear] > -3.0)
    assert not found[-1]
