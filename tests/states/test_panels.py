"""States, forecasts and free runs of a panel: those of a variable for each of its records."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.numerics.philox import seed_of_record
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.panel_records import records_of
from tests.states.models import EKF, posterior
from tests.systems import FORCED

pytestmark = pytest.mark.usefixtures("interpreted")

LABELS = np.array(["b", "b", "b", "a", "c", "c"])
STEPS = np.array([0, 2, 5, 3, 1, 4])
DATA = np.array([[0.1], [np.nan], [0.8], [-0.4], [0.9], [0.2]])
RECORDS = records_of(LABELS)
ROWS = dict(zip(RECORDS.labels, RECORDS.slices(), strict=True))
LONG = np.random.default_rng(4).normal(size=(3, 9))  # nine rows of the force of each record
FORCES = dict(zip(RECORDS.labels, LONG, strict=True))
A = np.random.default_rng(1).uniform(-0.5, 0.9, (2, 5, 3))
PARTICLES = psf.BootstrapPF(64)


def panel_model(filter=EKF, inputs=FORCES, **options):
    with pm.Model() as model:
        pm.Normal("a", shape=3)
        psf.StateSpace(
            "d", FORCED, filter, panel=LABELS, steps=STEPS, observed=DATA, inputs=inputs, **options
        )
    return model


def single_model(label, filter=EKF, force=None):
    rows = ROWS[label]
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace(
            "d",
            FORCED,
            filter,
            steps=STEPS[rows],
            observed=DATA[rows],
            inputs=FORCES[label] if force is None else force,
        )
    return model


def alone(function, idata, model, **options):
    """Results of a record alone. Its graphs run in Python: each would take seconds to compile."""
    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        return function(idata, model, **options)


def of_singles(function, group, *names, filter=EKF, **options):
    """Results of a model of each record, joined along the rows."""
    found = [
        alone(function, posterior(a=A[..., g]), single_model(label, filter), **options)[group]
        for g, label in enumerate(RECORDS.labels)
    ]
    return [np.concatenate([part[name].values for part in found], axis=2) for name in names]


@pytest.mark.parametrize("at", ["observations", "steps"])
@pytest.mark.parametrize("moment", ["filtered", "smoothed"])
def test_states_are_those_of_each_record_alone(moment, at):
    function, group = getattr(psf, f"{moment}_states"), f"{moment}_states"
    found = function(posterior(a=A), panel_model(), at=at)[group]
    expected = of_singles(function, group, "d_mean", "d_sd", at=at)
    np.testing.assert_array_equal(found["d_mean"], expected[0])
    np.testing.assert_array_equal(found["d_sd"], expected[1])
    assert found["d_states"].dims == ("chain", "draw", "d_obs", "state")
    if at == "observations":
        np.testing.assert_array_equal(found["d_panel"], LABELS)
        np.testing.assert_array_equal(found["d_time"], STEPS)
    else:
        np.testing.assert_array_equal(found["d_time"], [*range(6), *range(4), *range(5)])
        assert "".join(found["d_panel"].values) == "bbbbbbaaaaccccc"


def test_each_record_has_the_noise_of_its_own_estimate():
    """Stored by the chain for each record, or one for all."""
    own = np.arange(30).reshape(2, 5, 3) * 10**15
    for seeds in (own, own[..., 0]):
        idata = posterior(a=A)
        idata["sample_stats"] = posterior(d_seed=seeds)["posterior"]
        found = psf.filtered_states(idata, panel_model(PARTICLES))["filtered_states"]["d_mean"]
        for g, (label, rows) in enumerate(ROWS.items()):
            of_record = np.broadcast_to(np.atleast_3d(seeds), A.shape)[..., g]
            noise = [seed_of_record(seed, RECORDS.codes[g]) for seed in of_record.ravel()]
            single = posterior(a=A[..., g])
            stats = posterior(d_seed=np.reshape(noise, (2, 5)))
            single["sample_stats"] = stats["posterior"]
            expected = alone(psf.filtered_states, single, single_model(label, PARTICLES))
            expected = expected["filtered_states"]["d_mean"]
            np.testing.assert_array_equal(found[:, :, rows], expected)


def test_seeds_of_other_records_are_refused():
    idata = posterior(a=A)
    idata["sample_stats"] = posterior(d_seed=np.zeros((2, 5, 4), np.int64))["posterior"]
    with pytest.raises(
        ModelError, match=r"noise seeds of 4 records of 'd', of which the model has 3"
    ):
        psf.filtered_states(idata, panel_model(PARTICLES))


def test_records_do_not_change_with_their_order():
    """Fresh noise and drawn states belong to the label."""
    order = np.array([3, 4, 5, 0, 1, 2])
    with pm.Model() as permuted:
        pm.Normal("a", shape=3)
        psf.StateSpace(
            "d", FORCED, PARTICLES, panel=LABELS[order], steps=STEPS[order], observed=DATA[order],
            inputs=FORCES,
        )  # fmt: skip
    one = psf.smoothed_states(posterior(a=A), panel_model(PARTICLES), random_seed=1)
    other = psf.smoothed_states(posterior(a=A[..., [1, 2, 0]]), permuted, random_seed=1)
    one, other = (idata["smoothed_states"]["d_states"].values for idata in (one, other))
    np.testing.assert_array_equal(other, one[:, :, order])


def test_records_may_share_their_inputs():
    force = LONG[0]
    found = psf.smoothed_states(posterior(a=A), panel_model(inputs=force))["smoothed_states"]
    for g, (label, rows) in enumerate(ROWS.items()):
        model = single_model(label, force=force)
        expected = alone(psf.smoothed_states, posterior(a=A[..., g]), model)["smoothed_states"]
        np.testing.assert_array_equal(found["d_mean"][:, :, rows], expected["d_mean"])


def test_other_rows_set_after_sampling():
    """Another panel, with labels that the coordinates do not know."""
    with pm.Model() as model:
        pm.Normal("mu")
        panel, steps = pm.Data("panel", [7, 7, 8]), pm.Data("steps", [0, 2, 1])
        observed = pm.Data("observed", DATA[3:])
        psf.StateSpace(
            "d", FORCED, psf.EKF(), panel=panel, steps=steps, observed=observed,
            inputs=LONG[0], params={"a": model["mu"]},
        )  # fmt: skip
        pm.set_data({"panel": [3, 4, 5], "steps": [2, 0, 1], "observed": DATA[3:] + 1.0})
    found = psf.filtered_states(posterior(mu=A[..., 0]), model)["filtered_states"]
    np.testing.assert_array_equal(found["d_panel"], [3, 4, 5])
    expected = psf.run_filter(
        FORCED, psf.EKF(), {"a": A[0, 0, 0]}, DATA[3:4] + 1.0, steps=[2], inputs=LONG[0]
    )
    np.testing.assert_allclose(found["d_mean"][0, 0, 0], expected["mean"][0], rtol=1e-12)


@pytest.mark.parametrize("own", [True, False])
def test_forecasts_begin_at_the_end_of_each_record(own):
    """Linear means by hand: 4000 equal draws, within 5 standard errors."""
    a = np.broadcast_to([0.9, -0.3, 0.5], (4, 1000, 3))
    inputs = FORCES if own else LONG[1]
    model = panel_model(inputs=inputs)
    idata = psf.forecast(posterior(a=a), model, n_steps=2, random_seed=1)
    found = idata["predictions"]
    np.testing.assert_array_equal(found["d_time"], [6, 7, 4, 5, 5, 6])
    assert "".join(found["d_panel"].values) == "bbaacc"
    last = psf.filtered_states(posterior(a=a[:1, :1]), model)["filtered_states"]
    for g, label in enumerate(RECORDS.labels):
        end, force = ROWS[label].stop - 1, FORCES[label] if own else LONG[1]
        mean = last["d_mean"].values[0, 0, end, 0]
        variance = last["d_sd"].values[0, 0, end, 0] ** 2
        for i in range(2):
            mean = a[0, 0, g] * mean + force[STEPS[end] + i]
            variance = a[0, 0, g] ** 2 * variance + 1.0
            drawn = found["d"].values[:, :, 2 * g + i, 0].ravel()
            assert abs(drawn.mean() - mean) < 5 * np.sqrt((variance + 0.5) / 4000)
            assert abs(drawn.var() / (variance + 0.5) - 1) < 5 * np.sqrt(2 / 4000)


def test_forecasts_with_other_inputs():
    """Inputs of each record, past and future: those of the model give the same."""
    short = {label: force[: STEPS[ROWS[label]][-1]] for label, force in FORCES.items()}
    idata, model = posterior(a=A), panel_model(inputs=short)
    with pytest.raises(ModelError, match=r"record 'b': the model's inputs end after 5 rows"):
        psf.forecast(idata, model, n_steps=2)
    with pytest.raises(ModelError, match=r"record 'a', .*inputs must have at least 5 rows"):
        psf.forecast(idata, model, n_steps=2, inputs=FORCES | {"a": LONG[1][:4]})
    found = psf.forecast(idata, model, n_steps=2, inputs=FORCES, random_seed=1)
    expected = psf.forecast(posterior(a=A), panel_model(), n_steps=2, random_seed=1)
    assert found["predictions"].identical(expected["predictions"])
    ahead = {label: force[len(short[label]) :][:2] for label, force in FORCES.items()}
    found = psf.forecast(posterior(a=A), model, n_steps=2, inputs=ahead, random_seed=1)
    assert found["predictions"].identical(expected["predictions"])


def test_steps_to_forecast_are_after_all_records():
    with pytest.raises(ModelError, match=r"record 'b': steps must be after .*step 5, got 4"):
        psf.forecast(posterior(a=A), panel_model(), steps=[4, 6])


def test_free_runs_and_their_errors_belong_to_records():
    model = panel_model(score_from=1)
    with pytest.raises(ModelError, match="score_from must be"):
        panel_model(score_from=3)
    found = psf.free_run(posterior(a=A), model, random_seed=1)["free_run"]
    assert found["d_rmse"].dims == ("d_record", "observable")
    assert found["d_rmse_of_draws"].dims == ("d_record", "chain", "draw", "observable")
    np.testing.assert_array_equal(found["d_record"], RECORDS.labels)
    for g, (label, rows) in enumerate(ROWS.items()):
        for place in np.ndindex(2, 5):
            a, steps = A[(*place, g)], STEPS[rows]
            path = [0.0]
            for push in FORCES[label][: steps[-1]]:
                path.append(a * path[-1] + push)
            np.testing.assert_allclose(
                found["d"].values[(*place, rows)][:, 0], np.array(path)[steps]
            )
    # Rows before score_from do not count: of "b" one number is left, of "a" none.
    mean = found["d"].mean(("chain", "draw")).values[:, 0]
    assert found["d_rmse"].values[0, 0] == pytest.approx(abs(mean[2] - 0.8))
    assert np.isnan(found["d_rmse"].values[1, 0])
    other = psf.free_run(posterior(a=A), model, steps=[1, 2], inputs=LONG[2])["free_run"]
    assert other.sizes["d_obs"] == 6
    assert "d_rmse" not in other
    np.testing.assert_allclose(other["d"].values[..., 0, 0], LONG[2][0])


def test_a_free_run_is_compared_with_the_panels_own_data_alone():
    with pytest.raises(ModelError, match="observed must be None for a panel such as 'd'"):
        psf.free_run(posterior(a=A), panel_model(), observed=[1.0])


def test_inputs_that_depend_on_free_variables():
    with pm.Model() as model:
        gain = pm.Normal("gain")
        inputs = {label: gain * pt.as_tensor(force) for label, force in FORCES.items()}
        psf.StateSpace(
            "d", FORCED, psf.EKF(), panel=LABELS, steps=STEPS, observed=DATA, inputs=inputs,
            params={"a": 0.4},
        )  # fmt: skip
    gains = A[..., 0]
    found = psf.smoothed_states(posterior(gain=gains), model)["smoothed_states"]["d_mean"]
    for label, rows in ROWS.items():
        model = single_model(label, force=gains[1, 3] * FORCES[label])
        idata = alone(psf.smoothed_states, posterior(a=np.full((1, 1), 0.4)), model)
        expected = idata["smoothed_states"]["d_mean"][0, 0]
        np.testing.assert_allclose(found[1, 3, rows], expected, rtol=1e-12)


def test_one_warning_for_failures_of_all_records():
    idata = posterior(a=np.where(A > 0.5, 1e200, A))
    with pytest.warns(
        psf.errors.FilterWarning,
        match=r"gave -inf in \d+ of 30 evaluations, of records 'b', 'a', 'c'",
    ):
        psf.filtered_states(idata, panel_model())


def test_a_collapse_is_repeated_in_the_record_where_it_was():
    """A surprise in the last record, which has two rows."""
    surprising = DATA.copy()
    surprising[5] = 12.0
    with pm.Model() as model:
        pm.Normal("a", shape=3)
        psf.StateSpace(
            "d", FORCED, PARTICLES, panel=LABELS, steps=STEPS, observed=surprising, inputs=FORCES
        )
    told = r"of record 'c' \(.* these are 1 of 2 terms, j = 1"
    with pytest.warns(psf.errors.FilterWarning, match=told):
        psf.filtered_states(posterior(a=A), model, random_seed=1)
