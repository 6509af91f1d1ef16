"""The unscented Kalman filter: the equations by their values at sigma points, without derivatives.

S. J. Julier and J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92
(2004), with the scaling of E. A. Wan and R. van der Merwe, "The unscented Kalman filter for
nonlinear estimation" (2000). Points, weights and regression are in `gaussian.sigma_points`.
"""

from dataclasses import dataclass

from ..compiler.lowering.symbols import observation_moments
from ..system.checks import check_finite, check_positive
from ..system.model import StateSpaceModel
from .gaussian.base import GaussianFilterBase
from .gaussian.linearization import GaussianState, Seen, Symbols, seen
from .gaussian.sigma_points import SigmaPoints, at_points, check_kappa
from .protocol import System


@dataclass(frozen=True, kw_only=True)
class UKF(GaussianFilterBase):
    r"""Unscented Kalman filter: exact for linear systems, else closer than the EKF where it bends.

    The state is approximated as Gaussian between observations. Where the EKF takes tangents at the
    mean, this filter evaluates the equations at 2 n + 1 sigma points spread as the state is, so
    that means and covariances feel the curvature. It is deterministic, and its gradient is exact.
    As with the EKF, a state with several modes is beyond it.

    Parameters
    ----------
    alpha : float
        Scales the distance of the points from the mean.
    beta : float
        Adds to the weight of the central point in covariances.
    kappa : float, optional
        The points are ``alpha * sqrt(n + kappa)`` standard deviations from the mean. The default
        is ``max(3 - n, 0)``, with which no weight is negative: three points per state of a
        Gauss-Hermite rule for one state, those of the cubature filter from three states on.

    Raises
    ------
    ModelError
        If ``alpha`` is not positive or another setting is not finite; at use, if ``n + kappa`` is
        not positive.

    Notes
    -----
    An equation that is linear in state and noise needs no points: its tangent is exact. Process
    noise need not be additive, but enters by its Jacobian at zero noise, taken at every sigma
    point; so does ``e`` of the observation. Where a state is known exactly, the gradient by a
    parameter that would give it spread is that at no spread.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.UKF()
    UKF(alpha=1.0, beta=0.0, kappa=None)
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float | None = None

    def __post_init__(self) -> None:
        check_positive("alpha", self.alpha)
        check_finite("beta", self.beta)
        if self.kappa is not None:
            check_finite("kappa", self.kappa)

    @property
    def linearization(self) -> "Unscented":
        """Regressions over the state before each step and before each observation."""
        return Unscented(self.alpha, self.beta, self.kappa)

    def check(self, system: System) -> None:
        """Raise if the observation is not Gaussian, a state is carried, or points coincide."""
        self._check_gaussian(system)
        self._check_not_carried(system)
        self._check_no_jumping_parameters(system)
        check_kappa(self.kappa, system.n)


@dataclass(frozen=True)
class Unscented(SigmaPoints):
    """Statistical linear regression of observations as of steps."""

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """The observation ``values["d"]``, over the forecast."""
        moments = at_points(observation_moments, system, values)
        return seen(system, values, state, self.regress(moments, state.mean, state.root))
