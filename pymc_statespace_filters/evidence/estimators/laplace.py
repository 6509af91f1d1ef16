r"""Laplace's approximation of the evidence: a Gaussian at the mode.

With f = log prior + log likelihood + log Jacobian on the unconstrained space, of k dimensions, x*
its mode and H its Hessian there,

.. math::

    \ln p(D) \approx f(x^*) + \frac{k}{2} \ln 2 \pi - \frac{1}{2} \ln \det(-H)

(Tierney and Kadane, 1986). Exact if the posterior is Gaussian on the unconstrained space; else it
is off by an amount that more draws do not reduce, and so it has no standard error.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import arviz as az
import numpy as np
from numpy.typing import NDArray

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.newton import (
    BatchFunction,
    EdgeError,
    best_of_chains,
    derivatives,
    newton_maximize,
)
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.estimators.whitening import moments_within_chains
from pymc_statespace_filters.evidence.posterior.draws import Posterior

N_STARTS = 3
STEP = 0.05  # of the finer differences, in standard deviations of the draws; the coarser take two
MIN_CURVATURE = 0.01  # below, a Gaussian at the mode is ten times as wide as the draws
MAX_STEEPNESS = 0.1  # nats per standard deviation, at what is to be a mode
MAX_STEP_EFFECT = 0.1
MAX_EXCESS = 0.1

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Laplace:
    """Laplace's approximation; `se` is NaN, because nothing in it tells its error.

    The mode is sought from the best draws, in coordinates in which the draws have covariance one.
    The Hessian comes from central differences of two steps, extrapolated to fourth order.

    Examples
    --------
    Four parameters of prior N(0, 1), each observed once with noise N(0, 1):

    >>> import numpy as np
    >>> from scipy.stats import norm
    >>> from pymc_statespace_filters.evidence.estimators.laplace import Laplace
    >>> from pymc_statespace_filters.evidence.posterior import Posterior
    >>> def log_density(x):
    ...     return (norm.logpdf(x) + norm.logpdf(x, 1.0)).sum(axis=-1)
    >>> rng = np.random.default_rng(1)
    >>> draws = 0.5 + np.sqrt(0.5) * rng.standard_normal((2, 1000, 4))
    >>> posterior = Posterior(draws, log_density(draws), lambda x, rng: log_density(x))
    >>> found = Laplace().estimate(posterior, rng=rng)
    >>> bool(np.isclose(found.log_evidence, 4 * norm.logpdf(1.0, scale=np.sqrt(2)), atol=1e-6))
    True
    """

    name: ClassVar[str] = "laplace"

    def n_evaluations(self, posterior: Posterior) -> int:
        """The differences of some ten steps upwards from each start."""
        k = posterior.draws.shape[-1]
        return 10 * N_STARTS * (k * (k + 1) + 2)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from the mode alone.

        Raises
        ------
        ModelError
            If the likelihood is noisy, or the log-density has no mode inside its support.
        """
        if posterior.is_noisy:
            raise ModelError(
                "Laplace needs a log-density that is a function of the parameters: this likelihood "
                "is estimated with fresh noise each time and has neither mode nor curvature; use "
                "chib_jeliazkov or bridge, or a chain that held its seed"
            )
        coordinates = moments_within_chains(posterior.draws)

        def log_density(z: Array) -> Array:
            return posterior.evaluate(coordinates.unconstrained(z), rng)

        draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
        starts = draws[best_of_chains(posterior.log_density, N_STARTS)]
        tops = [newton_maximize(log_density, z) for z in coordinates.whitened(starts)]
        mode = max(tops, key=lambda top: top.value)
        log_dets = _log_curvature(log_density, mode.point)
        k = len(mode.point)
        log_det = log_dets[0] - 2 * np.log(np.diag(coordinates.chol)).sum()
        return Estimate(
            log_evidence=float(mode.value + 0.5 * k * np.log(2 * np.pi) - 0.5 * log_det),
            se=np.nan,
            settings={"log_density_at_mode": mode.value, "log_determinant": float(log_det)},
            doubts=tuple(_doubts(posterior, mode.value, log_dets)),
        )


def _log_curvature(log_density: BatchFunction, mode: Array) -> tuple[float, float]:
    """Log-determinant of -H in whitened coordinates; and its change between the two steps."""
    try:
        gradient, fine = derivatives(log_density, mode, STEP)
        _, coarse = derivatives(log_density, mode, 2 * STEP)
    except EdgeError:
        raise ModelError(
            "Laplace needs a mode inside the support: the largest log-density lies at its edge, "
            "where there is no curvature; use chib_jeliazkov or bridge, or give the "
            "parameter a transform"
        ) from None
    curvature = -(4 * fine - coarse) / 3
    smallest = np.linalg.eigvalsh(curvature)[0]
    steepest = np.abs(gradient).max()
    if smallest < MIN_CURVATURE or steepest > MAX_STEEPNESS:
        raise ModelError(
            "Laplace needs a mode with curvature in every direction: where the climb ended the "
            f"smallest curvature is {smallest:.2g} and the gradient {steepest:.2g}, in units of "
            "the draws' covariance. The log-density goes on growing, or levels off, towards a "
            "bound or along a ridge, or it is rugged, as with a held noise seed; use "
            "chib_jeliazkov or bridge"
        )
    log_det, of_fine, of_coarse = np.linalg.slogdet(np.stack([curvature, -fine, -coarse]))[1]
    return float(log_det), float(of_fine - of_coarse)


def _doubts(posterior: Posterior, at_mode: float, log_dets: tuple[float, float]) -> Iterator[str]:
    """Reasons for doubt: draws that are not Gaussian about the mode, or a rugged log-density."""
    effect = 0.5 * abs(log_dets[1])
    if effect > MAX_STEP_EFFECT:
        yield (
            f"the width of the differences changes it by {effect:.2g} nats: the log-density is "
            "rugged, as with a held noise seed; use an estimator that averages over draws"
        )
    # Under a Gaussian they lie k / 2 below on average; under heavier tails, or more modes, lower.
    depth = at_mode - posterior.log_density
    expected = 0.5 * posterior.draws.shape[-1]
    error = float(az.mcse(depth, method="mean"))
    if abs(depth.mean() - expected) > MAX_EXCESS + 3 * error:
        yield (
            f"the draws lie {depth.mean():.2f} nats below the mode on average where those of a "
            f"Gaussian lie {expected:.2f}: it may be off by as much as that; trust an estimator "
            "with a standard error instead"
        )
