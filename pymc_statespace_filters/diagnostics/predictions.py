"""The predictive distribution of every observation, mixed over the draws of the posterior."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp, ndtri_exp

from ..pymc_model.observation_moments import Moments, moments_of_observations, moments_on_tape
from ..pymc_model.state_space_variable import predictions_of, tape_of
from ..states.record import Array, RecordAtDraws, States
from ..statistics.pit import pit_of
from .calibration import residual_limit

# Fewer draws than this behind the probability of a tail, and one of them decides it.
_LEAST_DRAWS = 3.0
_LOWEST = -700.0  # log of a probability that is still positive in floating point
_LEAST_PIT = 1e-16  # tests of uniformity take no 0 and no 1
_MOST_NUMBERS = 2e6  # of the tapes of some draws
_TOLERANCE = 1e-6  # in nats, of a term from the moments of its prediction


class Laws(NamedTuple):
    """The law of every observation at every draw: moments, and logs of its two tails.

    ``mean`` and the tails are (draws, J, p), ``cov`` (draws, J, p, p); NaN where the filter failed.
    ``known`` tells whether they are the laws of the filter. Otherwise each is that of the
    observation of one state drawn from the prediction, and only their mixture means anything.
    """

    mean: Array
    cov: Array
    log_below: Array
    log_above: Array
    known: bool


class Calibration(NamedTuple):
    """PIT values, residuals, which of these are cut off, and moments of the predictions.

    (J, p) all, but the covariance ``cov``, (J, p, p).
    """

    pit: Array
    residual: Array
    clipped: NDArray[np.bool_]
    mean: Array
    cov: Array


def laws_of(record: RecordAtDraws, before: States) -> Laws | None:
    """The laws of the observations: the filter's if it knows them, else those given drawn states.

    The states are drawn ``before`` the observation. None where its noise is not Gaussian.
    """
    system = record.variable.system
    if system.equations.observation is None:
        return None
    if (predictions := predictions_of(record.variable)) is not None:
        found = record.evaluate(predictions, {"seed": before.seeds})
        mean, cov, log_below, log_above = found
        return Laws(mean, cov, log_below, log_above, known=True)
    if (taped := tape_of(record.variable)) is not None:
        terms, mean, cov = _linearised(record, taped, before.seeds)
        if _give_terms(mean, cov, record.measured, terms):
            return Laws(mean, cov, *_tails(mean, cov, record.scored), known=True)
    drawn = before.drawn.reshape(-1, system.n)
    mean, cov = _observations(record, Moments(drawn, None), slice(None))
    return Laws(mean, cov, *_tails(mean, cov, record.scored), known=False)


def _linearised(
    record: RecordAtDraws, taped: Callable[..., list[Array]], seeds: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Terms (draws, J) and the moments of every observation before it is seen.

    They are read from the tape of the filter, as if the observation were linear over the spread of
    the state. NaN where the filter failed.
    """
    system = record.variable.system
    on_tape = record.steps + np.arange(len(record.steps))
    # The tapes of so many draws at once need some ten megabytes.
    at_once = max(1, int(_MOST_NUMBERS / (on_tape[-1] + 1) / system.n**2))
    found = []
    for first in range(0, len(seeds), at_once):
        draws = slice(first, first + at_once)
        terms, tape = record.evaluate(taped, {"seed": seeds}, draws=draws)
        rows = tape[:, on_tape]
        rows[np.isneginf(terms).cumsum(axis=1) > 0] = np.nan
        states = moments_on_tape(system, rows.reshape(-1, rows.shape[-1]))
        found.append((terms, *_observations(record, states, draws)))
    terms, mean, cov = map(np.concatenate, zip(*found, strict=True))
    return terms, mean, cov


def _observations(record: RecordAtDraws, states: Moments, draws: slice) -> tuple[Array, Array]:
    """Moments (draws, J, p) and (draws, J, p, p) of observations, of states draw by draw."""
    system, theta = record.variable.system, record.theta[draws]
    n_draws, n_rows = len(theta), len(record.steps)
    inputs = np.zeros((1, n_rows, system.n_input_columns))
    if system.observation_uses_inputs:
        inputs = record.inputs[:, record.steps]
    inputs = np.broadcast_to(
        inputs[draws] if len(inputs) > 1 else inputs, (n_draws, *inputs.shape[1:])
    )
    t = np.tile(record.t0 + record.steps * system.dt, n_draws)
    mean, cov = moments_of_observations(
        system,
        states,
        t,
        inputs.reshape(n_draws * n_rows, -1),
        np.repeat(theta, n_rows, axis=0),
    )
    return (
        mean.reshape(n_draws, n_rows, system.p),
        cov.reshape(n_draws, n_rows, system.p, system.p),
    )


def calibration_of(
    laws: Laws, observed: Array, rng: np.random.Generator, flags: Array | float = 0.0
) -> Calibration:
    """Compare the observations (J, p) with the mixture of their laws.

    A censored one has no residual, and a transform anywhere on its side.
    """
    draws = np.isfinite(laws.mean)
    n_draws = draws.sum(axis=0)
    unseen = np.isnan(observed) | (n_draws == 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        below, few_below = _mixed(laws.log_below, draws)
        above, few_above = _mixed(laws.log_above, draws)
    is_low = below < above
    quantile = ndtri_exp(np.clip(np.where(is_low, below, above), _LOWEST, np.log(0.5)))
    residual = np.where(is_low, quantile, -quantile)
    limit = residual_limit(np.maximum(n_draws, 1))
    few = np.where(is_low, few_below, few_above) & (not laws.known)
    clipped = (few & (np.abs(residual) > limit)) | (np.minimum(below, above) < _LOWEST)
    residual = np.where(few, np.clip(residual, -limit, limit), residual)
    low, high = np.where(flags < 0, 0.0, np.exp(below)), np.where(flags > 0, 1.0, np.exp(below))
    pit = low + rng.uniform(size=low.shape) * (high - low)
    pit = np.where(unseen, np.nan, np.clip(pit, _LEAST_PIT, 1.0 - _LEAST_PIT))
    mean, cov = _mixed_moments(laws.mean, laws.cov)
    unmeasured = unseen | (flags != 0)
    residual = np.where(unmeasured, np.nan, residual)
    return Calibration(pit, residual, clipped & ~unmeasured, mean, cov)


def calibration_by_rank(
    predicted: Array, observed: Array, rng: np.random.Generator, flags: Array | float = 0.0
) -> Calibration:
    """Compare the observations with draws of their predictions (draws, J, p)."""
    pit = pit_of(observed, predicted, rng, flags)
    limit = residual_limit(len(predicted))
    with np.errstate(divide="ignore"):
        residual = np.clip(ndtri_exp(np.log(pit)), -limit, limit)
    residual = np.where(flags == 0, residual, np.nan)
    mean, cov = _mixed_moments(predicted, np.zeros((*predicted.shape, predicted.shape[-1])))
    return Calibration(pit, residual, np.abs(residual) >= limit, mean, cov)


def _tails(mean: Array, cov: Array, observed: Array) -> tuple[Array, Array]:
    """Logs of the probabilities of Gaussian variables to be below and above the observations."""
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    z = (observed - mean) / np.sqrt(variances)
    return log_ndtr(z), log_ndtr(-z)


def _give_terms(mean: Array, cov: Array, observed: Array, terms: Array) -> bool:
    """Whether terms (draws, J) are the Gaussian log-densities of the completely seen rows."""
    rows = ~np.isnan(observed).any(axis=1)
    draws = np.isfinite(mean).all(axis=(1, 2)) & np.isfinite(terms).all(axis=1)
    if not (rows.any() and draws.any()):
        return True
    z, S = (observed - mean)[draws][:, rows], cov[draws][:, rows]
    solved = np.linalg.solve(S, z[..., None])[..., 0]
    log_det = np.linalg.slogdet(2 * np.pi * S)[1]
    expected = -0.5 * (np.sum(z * solved, axis=-1) + log_det)
    return bool(np.allclose(terms[draws][:, rows], expected, rtol=_TOLERANCE, atol=_TOLERANCE))


def _mixed(log_tails: Array, draws: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Log of the mean of tail probabilities, and whether few draws decide it."""
    logs = np.where(draws & ~np.isnan(log_tails), log_tails, -np.inf)
    total = logsumexp(logs, axis=0)
    n_effective = np.exp(2 * total - logsumexp(2 * logs, axis=0))
    return total - np.log(draws.sum(axis=0)), ~(n_effective >= _LEAST_DRAWS)


def _mixed_moments(means: Array, covs: Array) -> tuple[Array, Array]:
    """Mean (J, p) and covariance (J, p, p) of a mixture over the draws that are not NaN."""
    draws = np.isfinite(means).all(axis=2)
    n = draws.sum(axis=0)[:, None]
    with np.errstate(invalid="ignore"):
        mean = np.where(draws[..., None], means, 0.0).sum(axis=0) / n
        apart = np.where(draws[..., None], means - mean, 0.0)
        between = np.einsum("sjb,sjc->jbc", apart, apart)
        within = np.where(draws[..., None, None], covs, 0.0).sum(axis=0)
        return mean, (between + within) / n[..., None]
