"""A run that goes on with more rows gives the bits of one run over all of them."""

import numpy as np
import pytest
import xarray as xr

import pymc_statespace_filters as psf

SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, u, a: [a * x[0] + q[0] + u[0], x[1] + x[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0], x[1]],
    observation_noise=[[0.5, 0.0], [0.0, 0.3]],
    initial_mean=[0.0, 0.0],
    initial_cov=[[1.0, 0.0], [0.0, 0.0]],
    inputs=["force"],
    accumulators=["x1"],
    resets="row",
)
RNG = np.random.default_rng(1)
STEPS = np.array([0, 2, 3, 7, 8, 12, 15])
DATA, FORCE = RNG.normal(size=(7, 2)), RNG.normal(size=(20, 1))
DATA[3, 0], DATA[4] = np.nan, np.nan
PANEL = np.array(["a", "a", "a", "a", "b", "b", "b"])
PANEL_STEPS = np.array([0, 2, 3, 7, 1, 4, 6])

FILTERS = [
    psf.EKF(),
    psf.UKF(),
    psf.IPLF(),
    psf.EnKF(40),
    psf.BootstrapPF(50),
    psf.BootstrapPF(50, resampling="sorted"),
    psf.BootstrapPF(33, resampling="multinomial", resample_below=1.0),
    psf.BootstrapPF(33, resample_below=0.0),
    psf.PFEnKF(70),
]
PF = psf.BootstrapPF(50)
pytestmark = pytest.mark.filterwarnings("ignore:.*fewer than 3 particles")


def run(filter, rows=slice(None), **changes):
    given = {"inputs": FORCE, "seed": 3, "at": "steps", "steps": STEPS[rows]} | changes
    return psf.run_filter(SYSTEM, filter, {"a": 0.5}, DATA[rows], **given)


def assert_joined(parts, whole, dims):
    for name, variable in whole.data_vars.items():
        if name.startswith("filter_state"):
            np.testing.assert_array_equal(parts[-1][name], variable)
            continue
        joined = np.concatenate([part[name] for part in parts])
        np.testing.assert_array_equal(joined, variable)
    for dim in dims:
        joined = np.concatenate([part[dim] for part in parts])
        np.testing.assert_array_equal(joined, whole[dim])


@pytest.mark.parametrize("filter", FILTERS, ids=repr)
def test_two_parts_are_one_run_wherever_it_is_cut(filter):
    """Also where the row at the cut is missing or holds the end of an accumulation."""
    whole = run(filter)
    for cut in range(1, STEPS.size):
        first = run(filter, slice(cut))
        second = run(filter, slice(cut, None), state=first)
        assert_joined([first, second], whole, ["time", "obs_time"])


def test_three_parts_at_the_observations_and_through_a_file(tmp_path):
    whole, parts, state = run(PF, at="observations"), [], None
    for number, rows in enumerate((slice(0, 2), slice(2, 5), slice(5, 7))):
        parts.append(run(PF, rows, at="observations", state=state))
        parts[-1].to_netcdf(tmp_path / f"{number}.nc")
        with xr.open_dataset(tmp_path / f"{number}.nc") as stored:
            state = stored.load()
    assert_joined(parts, whole, ["time", "obs_time"])


def test_every_record_of_a_panel_goes_on():
    filter = PF
    whole = run(filter, panel=PANEL, steps=PANEL_STEPS)
    early = np.array([True, True, False, False, True, False, False])
    first, second = early, ~early
    parts = []
    for rows in (first, second):
        state = parts[-1] if parts else None
        parts.append(run(filter, rows, panel=PANEL[rows], steps=PANEL_STEPS[rows], state=state))
    for label in "ab":
        for name, record in (("mean", "record"), ("log_likelihood", "obs_record")):
            joined = np.concatenate(
                [part[name].values[part[record].values == label] for part in parts]
            )
            np.testing.assert_array_equal(joined, whole[name].values[whole[record].values == label])


@pytest.mark.parametrize("filter", [psf.GuidedPF(40), psf.GuidedPF(40, resample_below=1.0)])
def test_a_guided_filter_in_the_same_parts_has_the_same_bits(filter, tmp_path):
    """Whatever of its states is shown, and through a file; its own state is among the bits."""
    for cut in (1, 3, 5):  # behind a missing row, too
        first = run(filter, slice(cut), at="observations")
        first.to_netcdf(tmp_path / f"{cut}.nc")
        with xr.open_dataset(tmp_path / f"{cut}.nc") as stored:
            state = stored.load()
        second = run(filter, slice(cut, None), at="observations", state=state)
        again = run(filter, slice(cut, None), state=run(filter, slice(cut)))
        np.testing.assert_array_equal(second["filter_state"], again["filter_state"])
        np.testing.assert_array_equal(second["log_likelihood"], again["log_likelihood"])
        np.testing.assert_array_equal(second["mean"][-1], again["mean"][-1])


def other_system():
    return psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0], x[1]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0], x[1]],
        observation_noise=[[0.5, 0.0], [0.0, 0.3]],
        initial_mean=[0.0, 0.0],
        initial_cov=[[1.0, 0.0], [0.0, 0.0]],
    )


REFUSED = [
    (psf.EnKF(50), {}, r"got one with filter BootstrapPF"),
    (psf.GuidedPF(50), {}, r"got one with filter BootstrapPF"),
    (psf.BootstrapPF(50, resample_below=0.5), {}, r"got one with filter BootstrapPF\(n_particles="),
    (PF, {"seed": 4}, r"got one with seed 3 instead of 4$"),
    (PF, {"t0": 1.0}, r"got one with t0 0.0 instead of 1.0$"),
    (PF, {"steps": STEPS[3:] - 4}, r"which is at step 3, got 3$"),
    (PF, {"state": DATA}, r"^state must be what run_filter returned, got ndarray$"),
    (PF, {"panel": PANEL[3:]}, r"^state must have the records .*, got those of None$"),
]


@pytest.mark.parametrize(("filter", "changes", "message"), REFUSED)
def test_what_is_not_the_same_run_is_refused_by_name(filter, changes, message):
    first = run(PF, slice(3))
    with pytest.raises(psf.errors.ModelError, match=message):
        run(filter, slice(3, None), **{"state": first} | changes)


def test_other_parameters_systems_and_failed_runs_are_refused():
    first = run(PF, slice(3))
    rows = {"steps": STEPS[3:], "seed": 3, "state": first}
    with pytest.raises(psf.errors.ModelError, match=r"parameters \[0.5\] instead of \[0.6\]$"):
        psf.run_filter(SYSTEM, PF, {"a": 0.6}, DATA[3:], inputs=FORCE, **rows)
    with pytest.raises(psf.errors.ModelError, match=r"got one with another system$"):
        psf.run_filter(other_system(), PF, {"a": 0.5}, DATA[3:], **rows)
    with pytest.warns(psf.errors.FilterWarning, match="gave -inf"):
        failed = psf.run_filter(
            SYSTEM, PF, {"a": 1e300}, DATA[:4], inputs=FORCE, seed=3, steps=STEPS[:4]
        )
    with pytest.raises(psf.errors.ModelError, match=r"^state must be of a run that did not fail"):
        psf.run_filter(
            SYSTEM, PF, {"a": 1e300}, DATA[4:], inputs=FORCE, seed=3, steps=STEPS[4:],
            state=failed,
        )  # fmt: skip
