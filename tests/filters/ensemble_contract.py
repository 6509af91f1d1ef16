"""What holds for every ensemble filter, and what the tests of their pages share."""

import numpy as np
import pytest

from pymc_statespace_filters.compiler.numerics.normals import fill_normals as fill
from pymc_statespace_filters.compiler.numerics.normals import padded
from pymc_statespace_filters.compiler.numerics.philox import INITIAL, OBSERVATION, PROCESS
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import LinearSystem, simulate
from tests.systems import DOUBLE_WELL_SYSTEM, linear_system


def linear(A, B, C, R, mean, root):
    """The linear system whose start has this square root of a covariance."""
    A, B, C, R, mean, root = (np.array(a, dtype=float) for a in (A, B, C, R, mean, root))
    return LinearSystem(A, B, C, R, mean, root @ root.T)


def written(system):
    """The model of a linear system."""
    return linear_system(system) if isinstance(system, LinearSystem) else system


def arguments(system, steps, observed, theta=None):
    """The inputs of a likelihood up to ``t0``; linear systems have their parameters."""
    theta = flat_parameters(written(system), {}) if theta is None else theta
    return theta, np.asarray(steps, np.int64), np.asarray(observed, float), np.zeros((0, 0)), 0.0


def run(filter_, system, steps, observed, seed=0, theta=None, normals=None):
    """Terms and health."""
    kind, noise = (LogLikelihood, seed) if normals is None else (LogLikelihoodOfNoise, normals)
    evaluate = evaluator(kind(written(system), filter_))
    return evaluate(*arguments(system, steps, observed, theta), noise)


def stored_noise(filter_, system, steps, seed):
    """The normals that a filter draws for a record of a linear system."""
    (stored,) = evaluator(StoredNoise(linear_system(system), filter_))(steps, seed)
    return stored


def kalman(system, steps, observed):
    """Exact terms of a linear system."""
    return kalman_log_likelihood(*system.kalman_arguments(), steps=steps, observed=observed)


def line_record():
    """One state observed at irregular steps, one observation missing."""
    system = linear([[0.9]], [[0.5]], [[1.0]], [[0.3]], [1.0], [[0.7]])
    steps = np.array([0, 1, 3, 4, 8, 9, 12, 15])
    observed = simulate(system, steps, np.random.default_rng(4))
    observed[3] = np.nan
    return system, steps, observed


def oscillator_record():
    """Two states, two observables of unlike precision, noise on the velocity only.

    Components are missing one by one and both at once.
    """
    system = linear(
        A=[[1.0, 0.1], [-0.2, 0.95]],
        B=[[0.0], [0.3]],
        C=[[1.0, 0.0], [0.5, 1.0]],
        R=[[0.05, 0.0], [0.0, 0.2]],
        mean=[0.5, 0.0],
        root=[[0.4, 0.0], [0.1, 0.5]],
    )
    steps = np.array([0, 2, 4, 5, 9, 12, 14, 20, 22, 25])
    observed = simulate(system, steps, np.random.default_rng(7))
    observed[1, 0] = observed[4, 1] = observed[6, 0] = np.nan
    observed[7] = np.nan
    return system, steps, observed


def well(alpha, beta, mean, sd):
    """Parameters of the double well: its drift, and the start of the state."""
    return np.array([alpha, beta, 0.6, 0.08, mean, sd**2], dtype=float)


LINE, OSCILLATOR = line_record(), oscillator_record()
WELL = DOUBLE_WELL_SYSTEM
PLAIN_START = well(4, -4, 1.0, 0.7)
WILD_START = well(4, -4, 0.0, 12.0)  # |x| beyond some 7 explodes in a few steps
LOST_START = well(4, -4, 1e3, 0.7)
SURE_START = well(4, -4, 1.0, 0.0)


def well_record():
    """Eleven observations of a double well near x = 1."""
    return np.arange(0, 101, 10), 1 + 0.3 * np.random.default_rng(3).standard_normal((11, 1))


def normals(seed, purpose, step, shape):
    """The noise that a filter draws, (components, members)."""
    Z = np.empty((shape[0], padded(shape[1])))
    fill(seed, purpose, step, Z)
    return Z[:, : shape[1]]


def forecasts(system, n_members, steps, seed):
    """A linear system in NumPy, one item per observation.

    The members at the start, a function from the analysis before to the forecast, and the noise of
    the simulated observations.
    """
    n, m = system.B.shape
    root = np.linalg.cholesky(system.cov)
    start = system.mean[:, None] + root @ normals(seed, INITIAL, 0, (n, n_members))
    before = [0, *steps[:-1]]
    for first, last in zip(before, steps, strict=True):

        def advance(X, first=first, last=last):
            for k in range(first, last):
                X = system.A @ X + system.B @ normals(seed, PROCESS, k, (m, n_members))
            return X

        noise = np.sqrt(np.diag(system.R))[:, None] * normals(
            seed, OBSERVATION, last, (len(system.R), n_members)
        )
        yield start, advance, noise


def log_gaussian(residual, variance):
    """Sum over rows of the log of N(residual; 0, variance), one variance per row."""
    variance = variance[:, None]
    return -0.5 * np.sum(residual**2 / variance + np.log(2 * np.pi * variance), axis=0)


class EnsembleFilterContract:
    """Inherit and give ``filter_``, a fixture of one filter."""

    def test_a_wholly_missing_row_is_as_if_it_were_not_there(self, filter_):
        system, steps, observed = OSCILLATOR
        terms, health = run(filter_, system, steps, observed)
        seen = ~np.isnan(observed).all(axis=1)
        without, health_without = run(filter_, system, steps[seen], observed[seen])
        assert not seen.all()
        assert np.all(terms[~seen] == 0)
        assert np.array_equal(terms[seen], without)
        assert np.array_equal(health, health_without)

    def test_nothing_observed_is_zero(self, filter_):
        system, _, observed = OSCILLATOR
        terms, health = run(filter_, system, [0, 3], np.full((2, 2), np.nan))
        assert terms.tolist() == [0, 0]
        assert health.tolist()[1:] == [0, -1]
        assert run(filter_, system, [], observed[:0])[0].shape == (0,)

    def test_same_seed_same_numbers_other_seed_others(self, filter_):
        system, steps, observed = OSCILLATOR
        terms, health = run(filter_, system, steps, observed, seed=-5)
        again, health_again = run(filter_, system, steps, observed, seed=-5)
        other, _ = run(filter_, system, steps, observed, seed=5)
        seen = terms != 0
        assert np.array_equal(terms, again)
        assert np.array_equal(health, health_again)
        assert np.all(terms[seen] != other[seen])

    def test_arguments_are_left_as_they_were(self, filter_):
        system, steps, observed = OSCILLATOR
        theta, *_ = arguments(*OSCILLATOR)
        given = (steps.copy(), observed.copy(), theta.copy())
        run(filter_, system, *given[:2], theta=given[2])
        assert np.array_equal(given[0], steps)
        assert np.array_equal(given[1], observed, equal_nan=True)
        assert np.array_equal(given[2], theta)

    def test_stored_normals_give_what_their_seed_gives_to_the_bit(self, filter_):
        system, steps, observed = OSCILLATOR
        stored = stored_noise(filter_, system, steps, 7)
        by_seed = run(filter_, system, steps, observed, seed=7)
        by_normals = run(filter_, system, steps, observed, normals=stored)
        assert np.array_equal(by_seed[0], by_normals[0])
        assert np.array_equal(by_seed[1], by_normals[1])
        assert stored.mean() == pytest.approx(0, abs=5 / np.sqrt(stored.size))  # 5 sd
        moved = run(filter_, system, steps, observed, normals=-stored)[0]
        assert np.all((moved != by_seed[0]) | (moved == 0))
        with pytest.raises(ModelError, match="normals must be those of this filter"):
            run(filter_, system, steps, observed, normals=stored[:-1])

    def test_a_later_observation_changes_no_earlier_term(self, filter_):
        system, steps, observed = OSCILLATOR
        terms, _ = run(filter_, system, steps, observed)
        shorter, _ = run(filter_, system, steps[:6], observed[:6])
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
        terms, health = run(filter_, WELL, steps, observed, theta=well(*theta, 1, 0.7))
        assert not np.isnan(terms).any()
        assert terms[-1] == -np.inf
        assert health[1] in (1, 2, 3)

    @pytest.mark.parametrize("outlier", [1e3, -1e9, 1e200])
    def test_absurd_data_give_no_nan(self, filter_, outlier):
        steps, observed = well_record()
        observed[5] = outlier
        terms, health = run(filter_, WELL, steps, observed, theta=PLAIN_START)
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
