r"""Laplace's approximation of the evidence: a Gaussian at the mode.

With f = log prior + log likelihood + log Jacobian on the unconstrained space of k dimensions, its
mode x* and the Hessian H there,

.. math::

    \ln p(D) \approx f(x^*) + \frac{k}{2} \ln 2 \pi - \frac{1}{2} \ln \det(-H)

(Tierney and Kadane, 1986). It is exact if the posterior is Gaussian on the unconstrained space;
otherwise its error does not decrease with more draws, and it has no standard error.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ..posterior import Posterior
from .newton import BatchFunction, EdgeError, best_of_chains, derivatives, newton_maximize
from .protocol import Estimate
from .whitening import moments_within_chains

N_STARTS = 3
STEP = 0.05  # of the fine differences, in standard deviations of the draws; doubled for the coarse
MIN_CURVATURE = 0.01  # below, a Gaussian at the mode is ten times as wide as the draws
MAX_STEEPNESS = 0.1  # nats per standard deviation, of the gradient at the mode
MAX_STEP_EFFECT = 0.1
MAX_EXCESS = 0.1

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Laplace:
    """Laplace's approximation; its `se` is NaN, because it has no estimate of its error.

    The mode is searched for from the best draws, in whitened coordinates. The Hessian is computed
    by central differences with two step sizes, extrapolated to fourth order.

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
    uses_draws: ClassVar[bool] = False  # the search for the mode starts from them

    def n_evaluations(self, posterior: Posterior) -> int:
        """The finite differences of about ten Newton steps from each starting point."""
        k = posterior.draws.shape[-1]
        return 10 * N_STARTS * (k * (k + 1) + 2)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from the mode and its curvature.

        Raises
        ------
        ModelError
            If the likelihood is noisy, or the log-density has no mode inside its support.
        """
        if posterior.is_noisy:
            raise ModelError(
                "Laplace needs a deterministic log-density: this likelihood is estimated with "
                "fresh noise at each evaluation; use chib_jeliazkov or bridge, or a chain that "
                "held its seed"
            )
        coordinates = moments_within_chains(posterior.draws)

        def log_density(z: Array) -> Array:
            return posterior.evaluate(coordinates.unconstrained(z), rng)

        draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
        starts = draws[best_of_chains(posterior.log_density, N_STARTS)]
        maxima = [newton_maximize(log_density, z) for z in coordinates.whitened(starts)]
        mode = max(maxima, key=lambda maximum: maximum.value)
        log_dets = _log_curvature(log_density, mode.point)
        k = len(mode.point)
        log_det = log_dets[0] - 2 * np.log(np.diag(coordinates.chol)).sum()
        return Estimate(
            log_evidence=float(mode.value + 0.5 * k * np.log(2 * np.pi) - 0.5 * log_det),
            se=np.nan,
            settings={"log_density_at_mode": mode.value, "log_determinant": float(log_det)},
            doubts=tuple(_check(posterior, mode.value, log_dets)),
        )


def _log_curvature(log_density: BatchFunction, mode: Array) -> tuple[float, float]:
    """Log-determinant of -H in whitened coordinates, and its change between the two step sizes."""
    try:
        gradient, fine = derivatives(log_density, mode, STEP)
        _, coarse = derivatives(log_density, mode, 2 * STEP)
    except EdgeError:
        raise ModelError(
            "Laplace needs a mode inside the support: the largest log-density lies at its edge; "
            "use chib_jeliazkov or bridge, or give the parameter a transform"
        ) from None
    curvature = -(4 * fine - coarse) / 3
    smallest = np.linalg.eigvalsh(curvature)[0]
    steepest = np.abs(gradient).max()
    if smallest < MIN_CURVATURE or steepest > MAX_STEEPNESS:
        raise ModelError(
            "Laplace needs a mode with curvature in every direction: where the search ended the "
            f"smallest curvature is {smallest:.2g} and the largest gradient {steepest:.2g}, in "
            "units of the draws' covariance. The log-density increases or levels off towards a "
            "bound or along a ridge, or it is rugged, as with a held noise seed; use "
            "chib_jeliazkov or bridge"
        )
    log_det, of_fine, of_coarse = np.linalg.slogdet(np.stack([curvature, -fine, -coarse]))[1]
    return float(log_det), float(of_fine - of_coarse)


def _check(posterior: Posterior, at_mode: float, log_dets: tuple[float, float]) -> Iterator[str]:
    """Check whether the log-density is smooth and the draws are Gaussian about the mode."""
    effect = 0.5 * abs(log_dets[1])
    if effect > MAX_STEP_EFFECT:
        yield (
            f"the step size of the differences changes it by {effect:.2g} nats: the log-density "
            "is rugged, as with a held noise seed; use an estimator that averages over draws"
        )
    # Draws of a Gaussian lie k / 2 below the mode on average; heavy tails or further modes, lower.
    depth = at_mode - posterior.log_density
    expected = 0.5 * posterior.draws.shape[-1]
    if abs(depth.mean() - expected) > MAX_EXCESS + 3 * posterior.mcse(depth):
        yield (
            f"the draws lie {depth.mean():.2f} nats below the mode on average where those of a "
            f"Gaussian lie {expected:.2f}: the error may be as large as the difference; use an "
            "estimator with a standard error"
        )
