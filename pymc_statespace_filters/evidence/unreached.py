"""Whether the chains have reached the posterior at all.

The search for the largest likelihood starts at the draws. If it ends where the posterior density is
far above that of every draw, one of two things is true: the chains have stayed below the posterior,
or they were right to leave a spike aside that holds no mass, as the neck of a funnel or a noise
scale of zero. The mass of a normal distribution at the posterior's mode nearby tells which
(Tierney and Kadane 1986). Of a noisy likelihood, whose curvature is unknown, the height decides,
as it does where the peak is so high that no width of floating-point numbers makes its mass small.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..statistics.axis_lengths import axis_lengths
from ..statistics.importance import log_mean
from ..statistics.lower_chains import TOLERATED
from .estimators.newton import BatchFunction, EdgeError, along, derivatives
from .posterior import Posterior

N_REPEATED = 40  # fresh estimates of a noisy likelihood
MIN_MASS = 3.0  # nats, by which the evidence around the peak exceeds that of the draws
N_QUARTERINGS = 24  # of the widths tried for the peak, from those of the draws on
MAX_CHANGE = 1.0  # nats, of the log-density along a width
N_STEPS, STEP = 12, 0.02  # Newton steps; of their differences, in widths
# Bounds of the curvature that a change of the widths trusts; nearness to one that is trusted.
RESCALING, NEAR_ONE = (1e-2, 1e4), 0.5
# Natural log of the relative distance of neighbouring floating-point numbers.
RESOLUTION = math.log(np.finfo(float).eps)

Array = NDArray[np.float64]


def check_reached(
    posterior: Posterior, peak: Array, log_evidence: float, rng: np.random.Generator
) -> str:
    """Why an evidence from draws is that of another place than the posterior; empty if it is not.

    ``peak`` (k,) is the point of the largest likelihood found.
    """
    n_repeats, k = N_REPEATED if posterior.is_noisy else 1, len(peak)
    at_peak = log_mean(posterior.evaluate(np.repeat(peak[None], n_repeats, axis=0), rng))
    gap = at_peak - float(posterior.log_density.max())
    if not gap > TOLERATED + k:
        return ""
    if not posterior.is_noisy and gap <= TOLERATED - RESOLUTION * k:
        spread = posterior.draws.reshape(-1, k).std(axis=0)
        mass = log_mass_at(lambda x: posterior.evaluate(x, rng), peak, spread)
        if mass is None or mass < log_evidence + MIN_MASS:
            return ""
    return (
        f"the chains never reached the posterior: its density at the largest likelihood found is "
        f"{gap:.0f} nats above that of the best draw, so that this evidence is that of another "
        "place and no standard error holds; start the chains there (initvals of the estimate of "
        "maximum_likelihood) and draw again"
    )


def log_mass_at(log_density: BatchFunction, start: Array, spread: Array) -> float | None:
    """Log-mass of the normal distribution at the mode near ``start`` (k,); None if there is none.

    Newton steps in scales that follow the curvature, from widths of a nat along each axis, found
    below ``spread`` (k,).
    """
    k, point = len(start), start
    scale = np.diag(axis_lengths(log_density, start, spread, N_QUARTERINGS, MAX_CHANGE)[1])
    for _ in range(N_STEPS):
        try:
            gradient, hessian = derivatives(along(log_density, point, scale), np.zeros(k), STEP)
        except EdgeError:
            return None
        curvature, directions = np.linalg.eigh(-hessian)
        settled = np.abs(curvature - 1).max() < NEAR_ONE and np.abs(gradient).max() < NEAR_ONE
        if settled:
            log_det = float(np.log(curvature).sum()) - 2 * float(np.linalg.slogdet(scale)[1])
            value = float(log_density(point[None])[0])
            return value + 0.5 * k * math.log(2 * math.pi) - 0.5 * log_det
        size = np.clip(np.abs(curvature), *RESCALING)
        step = directions @ (directions.T @ gradient / size)
        moved = point + scale @ (step / max(1.0, float(np.linalg.norm(step))))
        values = log_density(np.stack([point, moved]))
        point = moved if values[1] > values[0] else point
        scale = scale @ directions / np.sqrt(size)
    return None
