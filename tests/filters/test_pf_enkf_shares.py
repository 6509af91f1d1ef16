"""PFEnKF over ranks: terms and health to the bit those of one, on all ranks."""

from functools import cache

import numpy as np
import pytest

from pymc_statespace_filters.filters.outcomes import NO_FINITE_MEMBER, NONE, ZERO_WEIGHTS
from pymc_statespace_filters.filters.pf_enkf import PFEnKF
from tests.compiled import on_rank
from tests.filters.laws import LOST_START, OSCILLATOR, WELL, WILD_START, well_record
from tests.filters.machines import DOUBLE_WELL, linear_machine, scalar_record, simulate
from tests.ranks import on_ranks

LINE, SIZES = scalar_record(), (2, 3, 4)


def space_record():
    """Three states, of which the last is carried, and a clock that is known exactly."""
    machine = linear_machine(
        F=np.diag([0.9, 0.8, 0.7, 1.0]),
        G=np.vstack([0.3 * np.eye(3), np.zeros(3)]),
        H=np.eye(2, 4),
        R=0.1 * np.eye(2),
        m0=[0.0, 0.0, 0.0, 7.1],
        L0=np.diag([1.0, 1.0, 1.0, 0.0]),
        free=[0, 1, 3],
    )
    steps = np.arange(5)
    return machine, steps, simulate(machine, steps, seed=1)


SPACE = space_record()
MACHINES = {"line": LINE[0], "plane": OSCILLATOR[0], "space": SPACE[0], "well": WELL}


@cache
def compiled(filter_, name):
    return on_rank(filter_.compile(MACHINES[name]))


def assert_same(filter_, name, steps, observed, theta=(1.0,), sizes=SIZES):
    """Evaluate by one rank and by several; return what one gives."""
    given = (
        np.array(theta), np.asarray(steps, np.int64), np.asarray(observed, float),
        np.zeros((0, 0)), 0.0, 5,
    )  # fmt: skip
    run = compiled(filter_, name)
    terms, health = run(*given, 0, 1, 0)
    for size in sizes:
        results = on_ranks(size, lambda rank: run(*given, rank.rank, rank.size, rank.exchange))
        for terms_there, health_there in results:
            assert np.array_equal(terms_there, terms)
            assert np.array_equal(health_there, health)
    return terms, health


@pytest.mark.parametrize("likelihood", ["predictive", "weights", "as_printed"])
def test_by_grid_with_missing_components(likelihood):
    filter_ = PFEnKF(500, likelihood=likelihood, resample_below=0.9)
    terms, health = assert_same(filter_, "plane", *OSCILLATOR[1:])
    assert np.count_nonzero(terms) == 9
    assert health[1] == NONE


@pytest.mark.parametrize("resampling", ["systematic", "multinomial", "sorted"])
def test_every_scheme(resampling):
    filter_ = PFEnKF(300, resampling=resampling, resample_below=0.9)
    assert assert_same(filter_, "line", *LINE[1:])[1][1] == NONE


def test_exact_sums_with_a_carried_state_and_one_known_exactly():
    assert assert_same(PFEnKF(200), "space", *SPACE[1:], sizes=(2, 3))[1][1] == NONE


def test_as_many_ranks_as_blocks():
    assert_same(PFEnKF(320), "line", *LINE[1:], sizes=(5,))


@pytest.mark.parametrize("surprise", [4.0, 12.0, 1e3])
def test_a_surprising_observation(surprise):
    _, steps, observed = LINE
    observed = observed.copy()
    observed[4] += surprise
    terms, _ = assert_same(PFEnKF(300), "line", steps, observed)
    assert terms[4] < -surprise


def test_members_that_explode_on_some_ranks():
    terms, health = assert_same(PFEnKF(300), "well", *well_record(), theta=WILD_START)
    assert np.all(np.isfinite(terms))
    assert health[1] == NONE


def test_failures_are_the_same_on_all_ranks():
    steps, observed = well_record()
    _, health = assert_same(PFEnKF(300), "well", steps, observed, theta=LOST_START)
    assert health[1] == NO_FINITE_MEMBER
    far = observed.copy()
    far[3] = 1e160
    terms, health = assert_same(PFEnKF(300), "well", steps, far, theta=DOUBLE_WELL)
    assert health[1:].tolist() == [ZERO_WEIGHTS, 3]
    assert np.all(terms[3:] == -np.inf)


def test_all_weight_on_one_particle_falls_back_to_bootstrap_weights():
    # never resampled, and so precise a first observation that the second finds one particle
    steps = np.arange(4)
    observed = np.array([[80.0], [0.1], [0.2], [0.1]])
    filter_ = PFEnKF(130, resample_below=0)
    terms, health = assert_same(filter_, "well", steps, observed, theta=DOUBLE_WELL, sizes=(2,))
    assert health[0] < 1.01
    assert np.all(np.isfinite(terms))
