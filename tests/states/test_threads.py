"""Many draws at once: in any number of threads, watched, stopped, and failing."""

import time
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.ops import wrap_py

import pymc_statespace_filters as psf
from pymc_statespace_filters import progress
from pymc_statespace_filters.compiler.native import rows as many_calls
from pymc_statespace_filters.compiler.native.pytensor_function import NativeFunction
from pymc_statespace_filters.compiler.native.rows import Rows
from pymc_statespace_filters.pymc_model.state_space_variable import observed_variables
from pymc_statespace_filters.states import free_runs
from pymc_statespace_filters.states.draws import select_draws
from pymc_statespace_filters.states.variable import VariableAtDraws
from tests.interrupts import interrupt
from tests.states.models import EKF, pair_model, posterior
from tests.systems import PAIR, PAIR_DATA, STEPS

MANY = np.random.default_rng(5).uniform(-0.5, 0.9, (3, 5))


@pytest.fixture(scope="module")
def drawn():
    idata = psf.filtered_states(posterior(a=MANY), pair_model(), random_seed=1)
    return idata["filtered_states"].to_dataset()


@pytest.mark.parametrize("n_threads", [1, 4, 40])
def test_the_number_of_threads_does_not_matter(drawn, n_threads, monkeypatch):
    monkeypatch.setattr(many_calls, "available_cores", lambda: n_threads)
    idata = psf.filtered_states(posterior(a=MANY), pair_model(), random_seed=1)
    assert idata["filtered_states"].to_dataset().identical(drawn)


def test_draws_one_by_one_are_those_of_all_at_once(drawn):
    """Whatever their neighbours are."""
    some = psf.filtered_states(posterior(a=MANY[1:, :2]), pair_model(), random_seed=1)
    for name in ("d_mean", "d_sd"):
        expected = drawn[name].values[1:, :2]
        np.testing.assert_array_equal(some["filtered_states"][name], expected)


@pytest.mark.parametrize("in_turn", [False, True])
def test_results_of_several_shapes_and_types(in_turn):
    """Words of eight bytes, read as what they are."""
    x, n, c = pt.dvector("x"), pt.lscalar("n"), pt.lvector("c")
    function = pytensor.function([x, n, c], [x[::-1] * n, pt.outer(x, c), n], trust_input=True)
    columns = np.array([[1.5, 2.5], [0.5, -1.0], [3.0, 4.0]]), np.array([2**60, -3, 5])
    native = NativeFunction(function, [column[0] for column in columns] + [np.array([10, 20, 30])])
    calls = Rows(native, 2, in_turn=in_turn)
    found = calls(*columns)
    assert [part.shape for part in found] == [(3, 2), (3, 2, 3), (3,)]
    assert [part.dtype for part in found] == [np.float64, np.float64, np.int64]
    for a, k, reverse, outer, same in zip(*columns, *found, strict=True):
        np.testing.assert_array_equal(reverse, a[::-1] * k)
        np.testing.assert_array_equal(outer, np.outer(a, [10, 20, 30]))
        assert same == k
    counts = []
    calls.on_progress = counts.append
    calls(*columns)
    assert sum(counts) == 3
    # Strided columns, of another type.
    again = calls(np.asfortranarray(columns[0])[::-1], columns[1].astype(object)[::-1])
    for part, before in zip(again, found, strict=True):
        np.testing.assert_array_equal(part, before[::-1])


class Screen:
    """What a progress bar is asked for."""

    def __init__(self):
        self.bars, self.closed = [], 0

    def __call__(self):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.closed += 1

    def add_task(self, task, completed, total):
        self.bars.append([task, completed, total])
        return len(self.bars) - 1

    def advance(self, row, advance):
        self.bars[row][1] += advance


@pytest.fixture
def screen(monkeypatch):
    screen = Screen()
    monkeypatch.setattr("pymc.progress_bar.create_simple_progress", screen)
    return screen


@pytest.mark.parametrize(("patience", "progressbar"), [(0.0, True), (0.0, False), (60.0, True)])
def test_a_bar_for_work_that_takes_long(screen, patience, progressbar, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", patience)
    psf.filtered_states(posterior(a=MANY), pair_model(), progressbar=progressbar)
    shown = patience == 0.0 and progressbar
    assert screen.bars == ([["states", 15, 15]] if shown else [])
    assert screen.closed == len(screen.bars)


def at_draws_of(function, n_draws):
    """A variable with a parameter that a Python function makes, in PyTensor's mode for that."""
    with pm.Model() as model:
        a = wrap_py([pt.dscalar], [pt.dscalar])(function)(pm.Normal("a"))
        psf.StateSpace("d", PAIR, EKF, params={"a": a}, steps=STEPS, observed=PAIR_DATA)
    draws = select_draws(posterior(a=np.linspace(0.0, 1.0, n_draws)[None]), None)
    return VariableAtDraws(model, observed_variables(model)[0], draws)


def test_a_bar_that_appears_on_the_way_counts_all(screen, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.05)

    def slow(a):
        time.sleep(0.004)
        return np.asarray(a)

    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        at_draws = at_draws_of(slow, 60)
        with at_draws.progress("states", enabled=True):
            at_draws.records[0].states("filtered", STEPS, np.random.default_rng(1))
    assert screen.bars == [["states", 60, 60]]


def scores(idata, model, **bar):
    psf.leave_future_out(idata, model, min_observations=2, **bar)


def free_runs_of(idata, model, **bar):
    psf.free_run(idata, model, random_seed=1, **bar)


def checks(idata, model, **bar):
    psf.check_filter(idata, model, filter=psf.EnKF(100), n_draws=8, random_seed=1, **bar)


@pytest.mark.filterwarnings("ignore:1 of the 1 scores")
@pytest.mark.parametrize(
    ("work", "task", "total"),
    [
        (free_runs_of, "free runs", 60),
        (scores, "terms of d", 60),
        (checks, "check of EnKF(100) of d", 8),
    ],
)
def test_bars_of_other_work(screen, work, task, total, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    given = posterior(a=np.random.default_rng(5).uniform(0.3, 0.5, (2, 30))), pair_model()
    work(*given, progressbar=False)
    assert screen.bars == []
    work(*given)
    assert screen.bars == [[task, total, total]]


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_stops_free_runs(monkeypatch):
    calls = []

    def slow(rng, theta, steps, inputs, t0):
        calls.append(theta)
        if len(calls) == 20:
            interrupt()
        time.sleep(0.01)
        return np.zeros((steps[-1] + 1, 2)), np.zeros((len(steps), 2))

    monkeypatch.setattr(free_runs, "simulator", lambda *_: SimpleNamespace(function=slow))
    with pytest.raises(KeyboardInterrupt):
        psf.free_run(posterior(a=np.zeros((2, 5_000))), pair_model(), random_seed=1)
    assert 20 <= len(calls) < 10_000


def test_an_exception_arrives():
    def picky(a):
        if a > 0.5:
            raise ArithmeticError("too large")
        return np.asarray(a)

    with (
        pytensor.config.change_flags(mode="FAST_COMPILE"),
        pytest.raises(ArithmeticError, match="too large"),
    ):
        _ = at_draws_of(picky, 10).theta


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_stops_the_work():
    calls = []

    def slow(a):
        calls.append(a)
        if len(calls) == 20:
            interrupt()
        time.sleep(0.01)
        return np.asarray(a)

    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        at_draws = at_draws_of(slow, 10_000)
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            _ = at_draws.theta
    assert 20 <= len(calls) < 10_000
    done = len(calls)
    time.sleep(0.05)
    assert len(calls) == done


def test_a_record_that_machine_code_refuses():
    """Data exchanged for some that do not fit: the error is that of the machine code."""
    observed = pytensor.shared(PAIR_DATA)
    model = pair_model(observed=observed)
    observed.set_value(PAIR_DATA[:2])
    with pytest.raises(psf.errors.ModelError, match="a row for each step"):
        psf.filtered_states(posterior(a=MANY), model)


def test_other_modes_of_pytensor_give_the_same():
    numbers = psf.smoothed_states(posterior(a=MANY[:2]), pair_model(), random_seed=1)
    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        other = psf.smoothed_states(posterior(a=MANY[:2]), pair_model(), random_seed=1)
    assert other["smoothed_states"].identical(numbers["smoothed_states"])
