"""Rival models, their draws and their average, for all plots."""

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.stats import norm

from pymc_statespace_filters import average_models, compare_evidence
from pymc_statespace_filters.diagnostics.constancy.table import DriftScan
from pymc_statespace_filters.evidence import Evidence

TERMS = xr.Dataset(
    {
        "inclusion": ("term", [0.12, 0.98, 0.5]),
        "inclusion_se": ("term", [0.01, 0.02, 0.0]),
        "prior_inclusion": ("term", [0.5, 0.4, 0.5]),
    },
    coords={"term": ["c2", "k3", "k_f, k_h"]},
)
# As of `expected_information`, of two models.
DESIGNS = pd.DataFrame(
    {
        "information": [0.5, 0.3], "low": [0.4, 0.29], "high": [0.6, 0.31], "se": [0.03, 0.002],
        "decided": [0.8, 0.1],
        "parameters[cubic]": [1.5, 1.25], "parameters_low[cubic]": [1.25, 1.0],
        "parameters_high[cubic]": [1.75, 1.5], "parameters_se[cubic]": [0.25, 0.5],
    },
    index=pd.Index(["long", "short"], name="design"),
)  # fmt: skip


def a_field(mean, axes, visited):
    """As of `field`."""
    fields = {"mean": mean, "sd": 1 + abs(mean), "low": mean - 1, "high": mean + 1}
    data = xr.Dataset(
        {key: (tuple(axes), values) for key, values in fields.items()},
        coords={**axes, "visited_state": list(axes)},
        attrs={"ci_prob": 0.9},
    )
    return data.assign(visited=(("visit", "visited_state"), visited))


V, W = np.linspace(-1, 1, 9), np.linspace(0, 2, 7)
VISITS = np.random.default_rng(3).uniform([-0.5, 0.5], [0.5, 1.5], (600, 2))
FIELDS = xr.DataTree.from_dict(
    {
        "c": a_field(V**3, {"v": V}, VISITS[:, :1]),
        "e": a_field(np.outer(V, W), {"v": V, "w": W}, VISITS),
    }
)
X = xr.DataArray(np.linspace(-2, 2, 9), coords=[("displacement", np.linspace(-2, 2, 9))])


DRIFT_TIMES = np.arange(50) / 10


@pytest.fixture(scope="session")
def drift_scan():
    """Of two parameters in one record."""
    sums = np.stack([-np.sin(np.pi * np.arange(50) / 49), 0.1 * np.ones(50)])
    paths = xr.Dataset(
        {
            "cumulated": (("parameter", "time"), sums),
            "band": ("parameter", [0.5, 0.6]),
            "turn": ("parameter", [25, 3]),
        },
        coords={"parameter": ["gain", "a"], "time": DRIFT_TIMES},
    )
    table = pd.DataFrame(
        {"p_value": [0.01, 0.9], "p_alone": [0.005, 0.6], "statistic": [4.0, -0.2],
         "time": [2.5, 0.3], "change": [0.4, -0.1]},
        index=pd.Index(["gain", "a"], name="parameter"),
    )  # fmt: skip
    return DriftScan(table, paths=paths)


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def an_evidence(log_evidence, se, k=2, estimator="bridge"):
    return Evidence(log_evidence, se, estimator, k, 100, -5.0, "same")


@pytest.fixture(scope="session")
def rivals():
    return {
        "linear": an_evidence(-9.0, 0.2),
        "cubic": an_evidence(-5.0, 0.3, k=3),
        "quintic": an_evidence(-5.2, 0.4, k=4),
    }


@pytest.fixture(scope="session")
def table(rivals):
    return compare_evidence(rivals)


@pytest.fixture(scope="session")
def estimates():
    return {
        "bridge": an_evidence(-5.0, 0.02),
        "rough": an_evidence(-5.3, np.nan, estimator="rough"),
    }


@pytest.fixture(scope="session")
def draws():
    normals = np.random.default_rng(1).normal(size=(2, 4, 250))
    return {
        "linear": az.from_dict({"posterior": {"k": 2 + 0.1 * normals[0]}}),
        "cubic": az.from_dict({"posterior": {"k": 3 + 0.3 * normals[1]}}),
    }


def averaged(draws, function):
    return average_models(draws, {"linear": 1, "cubic": 3}, function, n_draws=4000, random_seed=1)


@pytest.fixture(scope="session")
def curve_average(draws):
    return averaged(draws, lambda posterior: (posterior["k"] * X).rename("force"))


@pytest.fixture(scope="session")
def scalar_average(draws):
    return averaged(draws, lambda posterior: posterior["k"])


@pytest.fixture(scope="session")
def average_in_panels(draws):
    sides = xr.DataArray([1.0, -1.0], coords=[("side", ["left", "right"])])
    return averaged(draws, lambda posterior: (posterior["k"] * X * sides).rename("force"))


TIMES = np.linspace(0, 4, 41)


def states_group(values, names, times=TIMES, **attrs):
    """A group of draws of states, values of shape (chain, draw, time, state)."""
    draws = (("chain", "draw", "d_time", "state"), values)
    return xr.Dataset({"d_states": draws}, coords={"d_time": times, "state": names}, attrs=attrs)


@pytest.fixture(scope="session")
def states():
    """Draws 0, 1, ..., 99 above a curve for each of two states, and a record of the first."""
    steps = np.arange(100.0).reshape(2, 50)[:, :, None, None]
    curves = np.stack([np.sin(TIMES), 10 * np.cos(TIMES)], axis=1)
    record = np.sin(TIMES[::5])[:, None].copy()
    record[3] = np.nan
    observed = xr.Dataset(
        {"d": (("d_time", "observable"), record)},
        coords={"d_time": TIMES[::5], "observable": ["position"]},
    )
    smoothed = states_group(curves + steps, ["position", "speed"], at="steps")
    at_observations = states_group(
        (curves - steps)[:, :, ::5], ["position", "speed"], TIMES[::5], at="observations"
    )
    return xr.DataTree.from_dict(
        {
            "smoothed_states": smoothed,
            "filtered_states": at_observations,
            "observed_data": observed,
        }
    )


@pytest.fixture(scope="session")
def forecast():
    """Of two observables, draws 0, 1, ..., 99 at ten times after a record of 31."""
    steps = np.arange(100.0).reshape(2, 50)[:, :, None, None]
    observables = ["position", "speed"]
    predictions = xr.Dataset(
        {"d": (("chain", "draw", "d_time", "observable"), steps + np.zeros((2, 50, 10, 2)))},
        coords={"d_time": TIMES[31:], "observable": observables},
    )
    predictions["d_states"] = (("chain", "draw", "d_time", "state"), predictions["d"].values)
    record = np.stack([np.sin(TIMES[:31]), np.cos(TIMES[:31])], axis=1)
    observed = xr.Dataset(
        {"d": (("d_time", "observable"), record)},
        coords={"d_time": TIMES[:31], "observable": observables},
    )
    return xr.DataTree.from_dict({"predictions": predictions, "observed_data": observed})


@pytest.fixture(scope="session")
def diagnostics():
    """Of two observables and particles, as of a good filter; the first lacks an observation."""
    residual = np.random.default_rng(4).normal(size=(41, 2))
    residual[3, 0] = np.nan
    over_time = ("d_time", "observable")
    effective = np.arange(1.0, 101).reshape(2, 50)[:, :, None] * np.ones(41)
    lags = np.arange(1, 11)
    group = xr.Dataset(
        {
            "d_residual": (over_time, residual),
            "d_pit": (over_time, norm.cdf(residual)),
            "d_n_effective": (("chain", "draw", "d_time"), effective),
            "d_innovation": (over_time, [0.5, 2.0] * residual),
            "d_innovation_cov": ((*over_time, "observable_bis"), [np.diag([0.25, 4.0])] * 41),
            "d_autocorrelation": (("lag", "observable"), np.outer(lags, [0.01, -0.02])),
            "d_predicted": (("chain", "draw", *over_time), residual + np.full((2, 50, 1, 1), 7.0)),
        },
        coords={
            "d_time": TIMES,
            "observable": ["position", "speed"],
            "lag": lags,
        },
    )
    stats = xr.Dataset({"n_failed": (("chain", "draw"), np.full((2, 3), 2))})
    return xr.DataTree.from_dict({"filter_diagnostics": group, "sample_stats": stats})


@pytest.fixture(scope="session")
def diagnostics_with_inputs(diagnostics):
    lags, correlations = np.arange(11), np.linspace(-0.4, 0.4, 44).reshape(11, 2, 2)
    group = diagnostics["filter_diagnostics"].to_dataset()
    group["d_input_correlation"] = (("input_lag", "input", "observable"), correlations)
    group = group.assign_coords(input_lag=lags, input=["force", "heat"])
    return xr.DataTree.from_dict({"filter_diagnostics": group})


@pytest.fixture(scope="session")
def simulated():
    """As of `simulate`: two states, the first and a voltage observed at every fifth step."""
    path = np.stack([np.sin(TIMES), 10 * np.cos(TIMES)], axis=1)
    record = np.stack([path[::5, 0] + 0.1, np.arange(9.0)], axis=1)
    return xr.Dataset(
        {
            "states": (("step", "state"), path),
            "observations": (("obs", "observable"), record),
        },
        coords={
            "step": np.arange(41),
            "state": ["position", "speed"],
            "obs": np.arange(0, 41, 5),
            "observable": ["position", "voltage"],
            "time": ("step", TIMES),
            "obs_time": ("obs", TIMES[::5]),
        },
    )


@pytest.fixture(scope="session")
def free_run(forecast):
    """A free run at the times of the record: draws -49.5, ..., 49.5 around it."""
    record = forecast["observed_data"].to_dataset()
    steps = np.arange(100.0).reshape(2, 50)[:, :, None, None] - 49.5
    group = xr.Dataset(
        {
            "d": (("chain", "draw", "d_time", "observable"), steps + record["d"].values + 0.25),
            "d_rmse_of_draws": (("chain", "draw", "observable"), np.ones((2, 50, 2))),
        },
        coords=record.coords,
    )
    return xr.DataTree.from_dict({"free_run": group, "observed_data": record})
