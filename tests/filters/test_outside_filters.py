"""Filters from a user's own file, three functions each, work everywhere."""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import ClassVar, NamedTuple

import numpy as np
import pymc as pm
import pytensor
import pytest
from numba import njit
from numba.core.runtime import _nrt_python, rtsys

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.entry_point import _compiled
from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.filters import (
    EnsembleFilter,
    Filter,
    ParticleFilter,
    bootstrap,
    enkf,
    failed,
    member_filter,
    updated,
)
from pymc_statespace_filters.filters.ensemble.evaluation import Members
from pymc_statespace_filters.filters.ensemble.loop import start
from pymc_statespace_filters.filters.outcomes import NOT_A_NUMBER
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import States
from tests.systems import PAIR, PAIR_DATA, STEPS
from tests.waiting import LIMIT

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "filter.md"
# One system with everything, inputs included: the filter of the page is compiled for each.
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, u, a: [a * x[0] + 0.1 * x[1] + u[0] + q[0], 0.9 * x[1] + q[1]],
    process_noise=[[0.5, 0.1], [0.1, 0.3]],
    observation=lambda x: [x[0], x[0] - x[1]],
    observation_noise=[[0.4, 0.1], [0.1, 0.2]],
    initial_mean=[0.5, 0.0],
    initial_cov=[[1.0, 0.2], [0.2, 0.5]],
    inputs=["force"],
)
RECORD_STEPS = np.array([0, 1, 3, 4, 8])
RECORD = np.array([[0.3, 0.1], [1.2, np.nan], [np.nan, np.nan], [0.4, 0.2], [-0.3, 0.5]])
FORCE = np.array([0.5, -0.2, 0.1, 0.3, 0.0, -0.4, 0.2, 0.6])
RUN = {"observed": RECORD, "steps": RECORD_STEPS, "inputs": FORCE}


GIVEN = np.array([0.7]), RECORD_STEPS, RECORD, FORCE[:, np.newaxis], 0.0, 3


@pytest.fixture(scope="module")
def page():
    """What the page "A new filter" defines, in a user's file."""
    assert "compiler" not in "".join(
        re.findall("^(?:from|import) .*", PAGE.read_text(), re.MULTILINE)
    )
    cells = re.findall(r"```\{code-cell\} python3\n(.*?)```", PAGE.read_text(), re.DOTALL)
    definitions = [cell.partition("\n\n\nfor ")[0] for cell in cells if "@dataclass" in cell]
    namespace = {"__name__": "a_users_file"}
    exec("\n".join(definitions), namespace)
    return namespace


@pytest.fixture(scope="module")
def cubature(page):
    return page["CubatureKF"]()


@njit(error_model="numpy")
def observe_as_bootstrap(call, j, k, parts):
    return bootstrap.observe(call, j, k, parts)


class Keeping(NamedTuple):
    members: Members
    kept: list


@njit(error_model="numpy")
def start_keeping(call):
    k, (members,) = start(call)
    return k, Keeping(members, [np.zeros(1), members.X[0]])


@njit(error_model="numpy")
def observe_keeping(call, j, k, parts):
    """As the bootstrap filter; keeps an array of every row, beside one of the members."""
    parts.kept.append(call.record.observed[j] + parts.kept[0])
    if parts.kept[1][0] != parts.members.X[0, 0]:
        return failed(NOT_A_NUMBER)
    return bootstrap.observe(call, j, k, parts)


@dataclass(frozen=True)
class OwnPF(ParticleFilter):
    """The bootstrap filter, by functions of one's own that keep arrays."""

    unbiased: ClassVar[bool] = True
    counts_copies: ClassVar[bool] = True
    entry: ClassVar = member_filter("own_pf", observe_keeping, start=start_keeping)


def test_what_an_outside_filter_is(cubature):
    assert isinstance(cubature, Filter)
    assert not isinstance(cubature, EnsembleFilter)
    assert isinstance(OwnPF(50), EnsembleFilter)
    assert cubature.entry.key is not None  # its machine code is kept on disk


def test_it_is_the_kalman_filter_on_linear_systems(cubature):
    both = cubature, psf.EKF()
    run, exact = (psf.run_filter(SYSTEM, f, {"a": 0.7}, **RUN, at="steps") for f in both)
    for name in ("mean", "sd", "cov", "log_likelihood"):
        np.testing.assert_allclose(run[name], exact[name], rtol=1e-8, atol=1e-12)
    assert "particles" not in run
    operations = (States(SYSTEM, f, "predicted") for f in both)
    found, exact = (evaluator(operation)(*GIVEN, np.arange(9), 1) for operation in operations)
    np.testing.assert_allclose(found[:2], exact[:2], rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(found[3], exact[3])  # no particles: infinitely many
    np.testing.assert_array_equal(found[4], exact[4])


def test_it_goes_on_with_the_bits_of_one_run(cubature):
    whole = psf.run_filter(SYSTEM, cubature, {"a": 0.7}, **RUN)
    tracker = psf.online(SYSTEM, cubature, {"a": 0.7})
    for cut in range(1, RECORD_STEPS.size):
        rest = None
        for rows in (slice(cut), slice(cut, None)):
            given = {**RUN, "observed": RECORD[rows], "steps": RECORD_STEPS[rows]}
            rest = psf.run_filter(SYSTEM, cubature, {"a": 0.7}, **given, state=rest)
        np.testing.assert_array_equal(rest["cov"], whole["cov"][cut:])
        np.testing.assert_array_equal(rest["filter_state"], whole["filter_state"])
    last = 0
    for k, d, mean in zip(RECORD_STEPS.tolist(), RECORD, whole["mean"].values, strict=True):
        if not np.isnan(d).all():
            row = tracker.update(d, step=k, inputs=FORCE[last:k])
            np.testing.assert_array_equal(row.mean, mean)
            last = k


def test_a_panel_is_its_records_one_by_one(cubature):
    a, panel = np.array([0.2, 0.7, -0.4]), np.repeat([1, 2, 3], 5)
    given = {"steps": np.tile(RECORD_STEPS, 3), "inputs": FORCE, "panel": panel}
    found = psf.log_likelihood(SYSTEM, cubature, {"a": a}, np.tile(RECORD, (3, 1)), **given)
    alone = [psf.log_likelihood(SYSTEM, cubature, {"a": one}, **RUN) for one in a]
    np.testing.assert_array_equal(np.ravel(found), np.concatenate(alone))


def test_it_is_sampled_and_gives_evidence_and_states(cubature):
    # Without numba PyTensor calls the machine code of the likelihood, which is there already.
    with pytensor.config.change_flags(mode="FAST_COMPILE"), pm.Model():
        pm.Uniform("a", -1.0, 1.0)
        psf.StateSpace("d", SYSTEM, cubature, **RUN)
        idata = psf.sample_dram(
            400, tune=200, chains=2, random_seed=3, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
        evidence = psf.chib_jeliazkov(idata, random_seed=1)
        states = psf.filtered_states(idata, n_draws=4, random_seed=2)["filtered_states"]
        with pytest.raises(psf.errors.ModelError, match="does not smooth; name a filter that does"):
            psf.smoothed_states(idata)
    assert idata.attrs["exact"]
    grid = np.linspace(-1.0, 1.0, 401)
    likelihood = np.exp(psf.log_likelihood(SYSTEM, psf.EKF(), {"a": grid}, **RUN).sum(axis=1))
    exact = np.log(np.trapezoid(likelihood, grid) / 2.0)
    assert evidence.log_evidence == pytest.approx(exact, abs=4 * evidence.se + 1e-3)
    assert evidence.se < 0.1
    a = float(idata.posterior["a"].isel(chain=0).sel(draw=states["draw"].values[0]))
    mean = psf.run_filter(SYSTEM, psf.EKF(), {"a": a}, **RUN)["mean"]
    np.testing.assert_allclose(states["d_mean"].values[0, 0], mean, rtol=1e-6, atol=1e-8)


def test_functions_that_call_those_of_a_filter_have_its_bits(page):
    """States, smoothed ones by backward simulation, and what is left at the end."""
    inflated = page["InflatedEnKF"]

    def run(filter):
        return psf.run_filter(SYSTEM, filter, {"a": 0.7}, **RUN, seed=3)

    def smoothed(filter):
        return evaluator(States(SYSTEM, filter, "smoothed"))(*GIVEN, np.arange(9), 1)[0]

    pairs = [(psf.BootstrapPF(70), OwnPF(70)), (psf.EnKF(70), inflated(70, inflation=1.0))]
    for built_in, own in pairs:
        assert run(built_in).identical(run(own).assign_attrs(run(built_in).attrs))
        np.testing.assert_array_equal(smoothed(built_in), smoothed(own))
    assert run(inflated(70, inflation=1.3))["sd"][-1, 0] > run(psf.EnKF(70))["sd"][-1, 0]


def test_the_memory_of_arrays_that_it_keeps_is_given_back():
    terms = psf.log_likelihood(SYSTEM, OwnPF(70), {"a": 0.7}, **RUN)
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    again = psf.log_likelihood(SYSTEM, OwnPF(70), {"a": 0.7}, **RUN)
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    np.testing.assert_array_equal(again, terms)
    assert after.alloc - before.alloc == after.free - before.free > 0


# What a user may write wrongly, and what is said.
THING = object()
WRONG = {
    "returns_number": r"^the functions of 'wrong' do not fit, returns_number returns float64: Unkn",
    "uses_object": r"^numba cannot compile uses_object of 'wrong': Untyped global name 'THING'",
    "returns_members": r"^the functions of 'wrong' do not fit, returns_members returns Members",
}


@njit(error_model="numpy")
def returns_number(call, j, k, parts):
    return 1.0


@njit(error_model="numpy")
def uses_object(call, j, k, parts):
    return updated(float(THING.value))


@njit(error_model="numpy")
def returns_members(call):
    return enkf.start(call)[1].members


@njit(error_model="numpy")
def fails_in_row_3(call, j, k, parts):
    if j == 3 and call.record.theta[0] == 0.7:
        raise ValueError("a message")
    return updated(np.nan if j == 3 and call.record.theta[0] == 0.9 else -1.0)


def own(observe, **functions):
    """A filter with these functions."""
    entry = member_filter("wrong", observe, **functions)
    return dataclass(frozen=True)(type("Own", (ParticleFilter,), {"entry": entry}))(50)


@pytest.mark.parametrize("name", WRONG)
def test_what_numba_cannot_compile_is_named(name):
    function = globals()[name]
    is_start = name == "returns_members"
    filter = own(observe_as_bootstrap, start=function) if is_start else own(function)
    with pytest.raises(ModelError, match=WRONG[name]):
        psf.log_likelihood(SYSTEM, filter, {"a": 0.7}, **RUN)


@pytest.mark.parametrize("observe", [lambda call, j, k, parts: None, njit(lambda call: None)])
def test_what_is_no_such_function_is_refused_at_once(observe):
    with pytest.raises(ModelError, match=r"^observe of the filter 'wrong' must be a func"):
        own(observe)


@pytest.fixture(scope="module")
def failing():
    return own(fails_in_row_3)


def test_an_increment_that_is_not_a_number_is_a_failure(failing):
    with pytest.warns(FilterWarning, match="gave -inf"):
        terms = psf.log_likelihood(SYSTEM, failing, {"a": 0.9}, **RUN)
    np.testing.assert_array_equal(np.isneginf(terms), np.arange(5) > 2)


def test_an_exception_is_a_failure_that_says_so(failing, monkeypatch):
    """From there on nothing is known, neither of this record of a panel nor of those behind it."""
    raised = []
    monkeypatch.setattr(sys, "unraisablehook", lambda one: raised.append(one.exc_type))
    panel, a = np.repeat([1, 2, 3], 5), np.array([0.2, 0.7, -0.4])
    given = {"steps": np.tile(RECORD_STEPS, 3), "inputs": FORCE, "panel": panel}
    with pytest.warns(FilterWarning, match="record 2, first in row 3, .* filter raised an exc"):
        terms = psf.log_likelihood(SYSTEM, failing, {"a": a}, np.tile(RECORD, (3, 1)), **given)
    np.testing.assert_array_equal(np.isneginf(terms), np.arange(15) > 7)
    assert set(raised) == {ValueError}


FILE = """
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from numba import njit
from pymc_statespace_filters.filters import ParticleFilter, member_filter, updated

SCALE = {scale}


@njit(error_model="numpy")
def scaled(x):
    return SCALE * x


@njit(error_model="numpy")
def observe(call, j, k, parts):
    return updated(scaled(call.record.observed[j, 1]))


@dataclass(frozen=True)
class Own(ParticleFilter):
    entry: ClassVar = member_filter("in_a_file", observe)
"""

SCRIPT = """
import json
import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.entry_point import _compiled
from own import Own
from tests.systems import PAIR, PAIR_DATA, STEPS

terms = psf.log_likelihood(PAIR, Own(50), {"a": 0.6}, PAIR_DATA, steps=STEPS)
print(json.dumps([terms.tolist(), _compiled[Own.entry.symbol].cache_hits]))
"""


def test_a_changed_function_never_meets_its_old_machine_code(tmp_path, monkeypatch):
    """Which another process finds on disk as long as nothing changes that the function reads."""
    file, scale, found = tmp_path / "own.py", np.random.default_rng().uniform(), []
    for one in (2 * scale, scale):  # here, where what all filters call is compiled already
        file.write_text(FILE.format(scale=one))
        monkeypatch.setitem(sys.modules, "own", module := ModuleType("own"))
        exec(compile(file.read_text(), str(file), "exec"), vars(module))
        own = module.Own
        terms = psf.log_likelihood(PAIR, own(50), {"a": 0.6}, PAIR_DATA, steps=STEPS)
        found.append([terms.tolist(), _compiled[own.entry.symbol].cache_hits])
    (second, _), (first, _) = found
    np.testing.assert_array_equal(second, 2 * np.array(first))
    assert [hits for _, hits in found] == [0, 0]
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=os.environ | {"PYTHONPATH": path},
        capture_output=True, timeout=LIMIT, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [first, 1]


def test_what_changes_before_it_is_compiled_is_an_error():
    namespace = {"__name__": "a_users_file"}
    exec(FILE.format(scale=1.0), namespace)
    namespace["SCALE"] = 2.0
    with pytest.raises(ModelError, match=r"^the functions of 'in_a_file' refer to some"):
        psf.log_likelihood(SYSTEM, namespace["Own"](50), {"a": 0.7}, **RUN)


@pytest.mark.parametrize("filter", [psf.EKF, OwnPF, "EKF", None])
def test_what_is_no_filter_is_refused(filter):
    with pytest.raises(psf.errors.ModelError, match=r"filter must be a filter such as psf.EKF\(\)"):
        psf.log_likelihood(SYSTEM, filter, {"a": 0.5}, **RUN)
