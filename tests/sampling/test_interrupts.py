"""Ctrl-C where it must not raise."""

import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

import pytest

from pymc_statespace_filters.parallel.signals import (
    deferred_interrupts,
    held_interrupts,
    ignored_interrupts,
    interrupts_are_noted,
    is_interrupted,
    keeps_what_is_there,
    takes_interrupt,
    unless_interrupted,
)

pytestmark = pytest.mark.usefixtures("interrupts_arrive")


def test_an_interrupt_is_noticed():
    with deferred_interrupts() as interrupted:
        assert not interrupted.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interrupted.is_set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_is_held_back():
    lines = iter([lambda: signal.raise_signal(signal.SIGINT), lambda: None])
    with pytest.raises(KeyboardInterrupt), held_interrupts():
        _ = [line() for line in lines]
    assert list(lines) == []  # all were run
    with deferred_interrupts() as interrupted, held_interrupts():
        signal.raise_signal(signal.SIGINT)
    assert interrupted.is_set()  # what surrounds it decides


def test_an_interrupt_is_left_to_another_rank():
    with ignored_interrupts():
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def press(result=None):
    signal.raise_signal(signal.SIGINT)
    return result


@keeps_what_is_there
def run(*parts, keeps=True):
    """What each part gives, a list of which the caller has the beginning."""
    if keeps:
        interrupts_are_noted()
    return [part() for part in parts]


def test_from_when_there_is_a_result_interrupts_are_noted():
    with pytest.raises(KeyboardInterrupt):
        run(press, keeps=False)
    assert run(press, is_interrupted, takes_interrupt, takes_interrupt) == [None, True, True, False]
    with pytest.raises(KeyboardInterrupt):
        press()  # the handler is the former one


def test_an_interrupt_that_is_ignored_stays_so():
    with ignored_interrupts():
        assert run(press, is_interrupted) == [None, False]


def test_an_interrupt_ends_what_can_be_done_without():
    first, second = (lambda: unless_interrupted(lambda: press("found"), "nothing"),) * 2
    third = partial(unless_interrupted, lambda: "found", "nothing")
    assert run(third, first, second, third) == ["found", "nothing", "nothing", "nothing"]
    assert run(press, takes_interrupt, third) == [None, True, "found"]
    with pytest.raises(KeyboardInterrupt):
        run(first, keeps=False)
    with pytest.raises(ArithmeticError):
        run(lambda: unless_interrupted(failing, "nothing"))


def test_an_interrupt_that_became_another_error_ends_it_too():
    """As numba makes a SystemError of one."""

    def broken():
        with suppress(KeyboardInterrupt):
            press()
        failing()

    assert run(lambda: unless_interrupted(broken, "nothing")) == ["nothing"]


def failing():
    raise ArithmeticError


def test_of_several_calls_those_are_kept_that_have_ended():
    found, one = [], lambda: found.append(run(press, takes_interrupt, keeps=True))

    @keeps_what_is_there
    def study(*calls):
        for call in calls:
            unless_interrupted(call, None)

    study(one, one)
    assert found == [[None, True]]  # taken there, it ends the others here
    study(lambda: found.append(run()), lambda: found.append(run(press, keeps=False)))
    assert found == [[None, True], []]
    with pytest.raises(KeyboardInterrupt):
        study(lambda: found.append(run(press, keeps=False)))
    within = keeps_what_is_there(one)  # as chains in a race of samplers in a study
    study(within, within)
    assert found == [[None, True], [], [None, True]]


@pytest.mark.parametrize("context", [deferred_interrupts, held_interrupts, ignored_interrupts])
def test_other_threads_are_never_interrupted(context):
    def inside():
        with context():
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(inside).result() is signal.default_int_handler
