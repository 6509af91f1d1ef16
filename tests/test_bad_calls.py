"""Every argument of the calls below, given each of a list of senseless values.

A call must refuse it at once by an error of the package, or a `TypeError`, whose message names the
argument. What an argument may well be is in `MEANT`.

On 2026-11-24 all 1052 calls were refused, in 17 seconds; before, 34 ended in an error of numpy or
Python, or passed.
"""

import inspect
import re

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from tests.systems import FREE

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

VALUES = {
    "an object": object(),
    "a text": "x",
    "bytes": b"x",
    "minus one": -1,
    "NaN": np.nan,
    "infinite": np.inf,
    "a fraction": 3.5,
    "an empty list": [],
    "a huge number": 10**30,
    "a complex number": 1j,
    "a cube": np.zeros((2, 2, 2)),
    "a dictionary": {1: 2},
}
RECORD = {"observed": [0.1, 0.2], "steps": [1, 2]}
AT = {"system": FREE, "params": {"a": 0.5}}


def drift(x, a):
    return [a * x[0]]


def with_model(call):
    """The call inside a model with a record."""

    def inside(**arguments):
        with pm.Model():
            pm.Uniform("a", 0.0, 1.0)
            psf.StateSpace("d", FREE, psf.EKF(), **RECORD)
            return call(**arguments)

    inside.__signature__ = inspect.signature(call)
    return inside


def in_system(integrator):
    """The integrator in a system: by itself it cannot tell what fits."""

    def inside(**arguments):
        return psf.StateSpaceModel(
            transition=integrator(**{"dt": 0.1} | arguments),
            observation=lambda x: [x[0]],
            observation_noise=[[0.5]],
            initial_mean=[0.0],
            initial_cov=[[1.0]],
        )

    inside.__signature__ = inspect.signature(integrator)
    return inside


def variable(**arguments):
    with pm.Model():
        pm.Uniform("a", 0.0, 1.0)
        return psf.StateSpace(**{"name": "d", "system": FREE, "filter": psf.EKF()} | arguments)


def designs(**arguments):
    with pm.Model() as built:
        pm.Uniform("a", 0.0, 1.0)
        psf.StateSpace("d", FREE, psf.EKF(), steps=[1])
    given = {"models": built, "designs": {"x": {"steps": [1]}}} | arguments
    return psf.expected_information(given.pop("models"), given.pop("designs"), **given)


designs.__signature__ = inspect.signature(psf.expected_information)
SHORT = {"draws": 2, "tune": 2, "chains": 1, "cores": 1, "progressbar": False}
CALLS = {
    "UKF": (psf.UKF, {}),
    "IPLF": (psf.IPLF, {}),
    "EnKF": (psf.EnKF, {"n_members": 10}),
    "BootstrapPF": (psf.BootstrapPF, {"n_particles": 10}),
    "GuidedPF": (psf.GuidedPF, {"n_particles": 10}),
    "PFEnKF": (psf.PFEnKF, {"n_particles": 10}),
    "GridFilter": (psf.GridFilter, {}),
    "EulerMaruyama": (in_system(psf.EulerMaruyama), {"drift": drift, "diffusion": [[1.0]]}),
    "RungeKutta4": (in_system(psf.RungeKutta4), {"drift": drift}),
    "log_likelihood": (psf.log_likelihood, AT | RECORD | {"filter": psf.EKF()}),
    "run_filter": (psf.run_filter, AT | RECORD | {"filter": psf.EKF()}),
    "simulate": (psf.simulate, AT | {"steps": [1, 2]}),
    "nearest_steps": (psf.nearest_steps, {"times": [0.1, 0.2], "dt": 0.1}),
    "StateSpace": (variable, RECORD),
    "sample_dram": (with_model(psf.sample_dram), SHORT),
    "find_starts": (with_model(psf.find_starts), {"chains": 1, "progressbar": False}),
    "expected_information": (designs, {"n_records": 20, "n_draws": 20, "progressbar": False}),
    "maximum_likelihood": (with_model(psf.maximum_likelihood), {}),
}
# Inherited from PyMC or meant for anything; handled by others.
ANYTHING = {"kwargs", "model", "comm", "step", "var_names", "idata_kwargs", "return_inferencedata"}
NUMBERS = ("minus one", "a fraction", "a huge number")
MEANT = (
    {("UKF", name, value) for name in ("alpha", "beta", "kappa") for value in NUMBERS}
    | {(call, "t0", value) for call in CALLS for value in NUMBERS}
    # A seed is any integer here, as for numpy a long one or an empty list.
    | {(call, "seed", "minus one") for call in CALLS}
    | {
        (call, "random_seed", value)
        for call in CALLS
        for value in ("a huge number", "an empty list")
    }
    | {("nearest_steps", "dt", "a huge number"), ("sample_dram", "cores", "a huge number")}
    | {("sample_dram", "until_ess", value) for value in ("a fraction", "a huge number")}
    | {
        ("expected_information", argument, value)
        for argument in ("odds", "target_se")
        for value in ("a fraction", "a huge number")
    }
    | {("expected_information", "cores", "a huge number")}
    | {("StateSpace", "name", "a text"), ("sample_dram", "checkpoint", "a text")}
    | {(call, "dt", value) for call in CALLS for value in ("a fraction", "a huge number")}
    | {("EulerMaruyama", "diffusion", value) for value in NUMBERS}
    | {("RungeKutta4", "diffusion", value) for value in NUMBERS}
)
# Times are steps as soon as they are rounded; what `pm.sample` does not know it calls a ValueError.
ALSO_NAMED = {"times": "steps"}


def cases():
    for name, (call, arguments) in CALLS.items():
        known = inspect.signature(
            psf.StateSpace.__new__ if name == "StateSpace" else call
        ).parameters
        for argument in known:
            if argument in ANYTHING or argument in ("cls", "self"):
                continue
            for title, value in VALUES.items():
                if (name, argument, title) not in MEANT:
                    yield pytest.param(
                        call, arguments, argument, value, id=f"{name}, {argument}: {title}"
                    )


@pytest.mark.parametrize(("call", "arguments", "argument", "value"), list(cases()))
def test_a_senseless_argument_is_refused_by_name(
    call, arguments, argument, value, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # a call that takes a path for good must not write elsewhere
    names = f"{argument}|{ALSO_NAMED.get(argument, argument)}"
    with pytest.raises((psf.errors.StateSpaceFiltersError, TypeError, ValueError)) as caught:
        call(**arguments | {argument: value})
    assert re.search(rf"\b({names})\b", str(caught.value)), caught.value
