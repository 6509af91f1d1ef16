"""What holds for every ensemble filter, and what their page tests share."""

import functools

import numpy as np
import pytest

from pymc_statespace_filters.compiler.numerics.normals import fill_normals as fill
from pymc_statespace_filters.compiler.numerics.normals import padded
from pymc_statespace_filters.compiler.numerics.philox import INITIAL, OBSERVATION, PROCESS
from pymc_statespace_filters.errors import ModelError
from tests.filters.machines import DOUBLE_WELL, double_well_machine, evaluate, oscillator_record

_machines = {}


@functools.cache
def _compiled(filter_, name):
    return filter_.compile(_machines[name])


def run(filter_, machine, steps, observed, **kwargs):
    """Evaluate a filter, compiling each pair of filter and machine once."""
    _machines[id(machine)] = machine  # also keeps the machine, and so its id, alive
    return evaluate(_compiled(filter_, id(machine)), machine, steps, observed, **kwargs)


OSCILLATOR = oscillator_record()
WELL = double_well_machine()
WILD_START = (4.0, -4.0, 0.0, 12.0)  # |x| beyond some 7 explodes in a few steps
LOST_START = (4.0, -4.0, 1e3, 0.7)
SURE_START = (4.0, -4.0, 1.0, 0.0)


def well_record():
    """Eleven observations of a double well near x = 1."""
    return np.arange(0, 101, 10), 1 + 0.3 * np.random.default_rng(3).standard_normal((11, 1))


def normals(seed, purpose, step, shape):
    """The noise that a filter draws, (components, members)."""
    Z = np.empty((shape[0], padded(shape[1])))
    fill(seed, purpose, step, Z)
    return Z[:, : shape[1]]


def forecasts(machine, n_members, steps, seed):
    """Linear machine in NumPy, one item per observation.

    The members at the start, a function from the analysis before to the forecast, and the noise of
    the simulated observations.
    """
    F, G, _, R, m0, L0 = machine.matrices
    start = m0[:, None] + L0 @ normals(seed, INITIAL, 0, (machine.n, n_members))
    before = [0, *steps[:-1]]
    for first, last in zip(before, steps, strict=True):

        def advance(X, first=first, last=last):
            for k in range(first, last):
                X = F @ X + G @ normals(seed, PROCESS, k, (machine.m, n_members))
            return X

        noise = np.sqrt(np.diag(R))[:, None] * normals(
            seed, OBSERVATION, last, (machine.r, n_members)
        )
        yield start, advance, noise


def log_gaussian(residual, variance):
    """Sum over rows of the log of N(residual; 0, variance), one variance per row."""
    variance = variance[:, None]
    return -0.5 * np.sum(residual**2 / variance + np.log(2 * np.pi * variance), axis=0)


class EnsembleFilterLaws:
    """Inherit and give ``filter_``, a fixture of one filter."""

    def test_a_wholly_missing_row_is_as_if_it_were_not_there(self, filter_):
        machine, steps, observed = OSCILLATOR
        terms, health = run(filter_, machine, steps, observed)
        seen = ~np.isnan(observed).all(axis=1)
        without, health_without = run(filter_, machine, steps[seen], observed[seen])
        assert not seen.all()
        assert np.all(terms[~seen] == 0)
        assert np.array_equal(terms[seen], without)
        assert np.array_equal(health, health_without)

    def test_nothing_observed_is_zero(self, filter_):
        machine, _, observed = OSCILLATOR
        terms, health = run(filter_, machine, [0, 3], np.full((2, 2), np.nan))
        assert terms.tolist() == [0, 0]
        assert health.tolist()[1:] == [0, -1]
        assert run(filter_, machine, [], observed[:0])[0].shape == (0,)

    def test_same_seed_same_numbers_other_seed_others(self, filter_):
        machine, steps, observed = OSCILLATOR
        terms, health = run(filter_, machine, steps, observed, seed=-5)
        again, health_again = run(filter_, machine, steps, observed, seed=-5)
        other, _ = run(filter_, machine, steps, observed, seed=5)
        seen = terms != 0
        assert np.array_equal(terms, again)
        assert np.array_equal(health, health_again)
        assert np.all(terms[seen] != other[seen])

    def test_arguments_are_left_as_they_were(self, filter_):
        machine, steps, observed = OSCILLATOR
        given = (steps.copy(), observed.copy(), np.ones(1))
        run(filter_, machine, *given[:2], theta=given[2])
        assert np.array_equal(given[0], steps)
        assert np.array_equal(given[1], observed, equal_nan=True)
        assert given[2] == 1

    def test_stored_normals_give_what_their_seed_gives_to_the_bit(self, filter_):
        machine, steps, observed = OSCILLATOR
        stored = filter_.stored_noise(machine)(np.asarray(steps, np.int64), 7)
        by_seed = run(filter_, machine, steps, observed, seed=7)
        by_normals = run(filter_, machine, steps, observed, seed=8, normals=stored)
        assert np.array_equal(by_seed[0], by_normals[0])
        assert np.array_equal(by_seed[1], by_normals[1])
        assert stored.mean() == pytest.approx(0, abs=5 / np.sqrt(stored.size))  # 5 sd
        moved = run(filter_, machine, steps, observed, normals=-stored)[0]
        assert np.all((moved != by_seed[0]) | (moved == 0))
        with pytest.raises(ModelError, match="normals must be those of this filter"):
            run(filter_, machine, steps, observed, normals=stored[:-1])

    def test_a_later_observation_changes_no_earlier_term(self, filter_):
        machine, steps, observed = OSCILLATOR
        terms, _ = run(filter_, machine, steps, observed)
        shorter, _ = run(filter_, machine, steps[:6], observed[:6])
        assert np.array_equal(terms[:6], shorter)

    def test_members_that_explode_count_as_zero_and_the_rest_go_on(self, filter_):
        steps, observed = well_record()
        terms, health = run(filter_, WELL, steps + 10, observed, theta=WILD_START)
        assert np.all(np.isfinite(terms))
        assert health[1:].tolist() == [0, -1]
        assert 0 < health[0] < 200

    def test_when_all_members_explode_terms_are_minus_infinity_from_there_on(self, filter_):
        steps, observed = well_record()
        steps, observed = np.append([0], steps + 1), np.concatenate([[[1000.0]], observed])
        # With other seeds an update may bring some members back.
        terms, health = run(filter_, WELL, steps, observed, theta=LOST_START, seed=3)
        failing = int(health[2])
        assert health[0] == 0
        assert 0 < failing <= 2
        assert np.all(np.isfinite(terms[:failing]))
        assert np.all(terms[failing:] == -np.inf)

    @pytest.mark.parametrize("theta", [(1e6, -4), (4, 100), (-1e6, -4), (np.nan, -4)])
    def test_absurd_parameters_give_minus_infinity_and_a_reason(self, filter_, theta):
        steps, observed = well_record()
        terms, health = run(filter_, WELL, steps, observed, theta=(*theta, 1, 0.7))
        assert not np.isnan(terms).any()
        assert terms[-1] == -np.inf
        assert health[1] in (1, 2, 3)

    @pytest.mark.parametrize("outlier", [1e3, -1e9, 1e200])
    def test_absurd_data_give_no_nan(self, filter_, outlier):
        steps, observed = well_record()
        observed[5] = outlier
        terms, health = run(filter_, WELL, steps, observed, theta=DOUBLE_WELL)
        assert not np.isnan(terms).any()
        assert terms[5] < -1e5
        assert np.all(np.isfinite(terms[:5]))
        assert (health[1] == 0) == np.isfinite(terms).all()

    def test_a_start_without_spread_is_no_failure(self, filter_):
        steps, observed = well_record()
        terms, health = run(filter_, WELL, steps, observed, theta=SURE_START)
        # at step 0 every member is at 1: the density is that of the sensor alone
        exact = -0.5 * (observed[0, 0] - 1) ** 2 / 0.08 - 0.5 * np.log(2 * np.pi * 0.08)
        assert terms[0] == pytest.approx(exact, abs=self.known_start_tolerance)
        assert np.all(np.isfinite(terms))
        assert health[1] == 0

    known_start_tolerance = 1e-12
