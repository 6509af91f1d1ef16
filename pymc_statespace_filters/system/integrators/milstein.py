"""Milstein steps, for noise that depends on the state."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant
from pytensor.graph.traversal import ancestors, graph_inputs
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from .euler_maruyama import EulerMaruyama
from .substeps import SubstepIntegrator, Values, check_needed, root_of

N_TRIALS = 6


@dataclass(frozen=True)
class Milstein(SubstepIntegrator):
    r"""Milstein steps of :math:`dx = f(x)\,dt + G(x)\,dW` (Ito), for diagonal or scalar noise.

    .. math::
        x_{k+1} = x_k + h f(x_k) + \sqrt{h}\, G(x_k)\, q_k
        + \tfrac{h}{2} \sum_j \frac{\partial g_j}{\partial x}(x_k)\, g_j(x_k)\, (q_{k,j}^2 - 1)

    with the columns ``g_j`` of ``G`` and ``h = dt / substeps``. The strong order is 1, where that
    of `EulerMaruyama` is 1/2; the weak order is 1 for both. With additive noise both are the same.
    Derivatives are automatic.

    Without further terms, which need iterated integrals of pairs of Wiener processes (Levy areas),
    this is of strong order 1 if no noise acts on a state that another noise depends on: diagonal
    noise, where row i of ``G`` has one entry, a function of state i; scalar noise, one column; any
    noise that depends only on states without noise. Others are refused.

    Parameters
    ----------
    drift : callable
        ``f(x, u, t, ...)`` as for `EulerMaruyama`.
    diffusion : callable or array_like, shape (n, m)
        ``G(x, u, t, ...)`` as for `EulerMaruyama`, which must be given.
    dt : float
        Length of one step, in the time unit of the drift.
    substeps : int
        Number of Milstein steps within one step of length ``dt``; inputs are held.

    Notes
    -----
    ``q`` enters by its square. `EKF`, `UKF`, `IPLF` and `EnKF` take noise by its mean and
    covariance: they use the steps of `EulerMaruyama`, which have the same mean and, to leading
    order in ``h``, the same covariance. `BootstrapPF` and `PFEnKF` take the steps as they are;
    `GuidedPF` and `GridFilter`, which need Gaussian noise, refuse them.

    References
    ----------
    Kloeden and Platen (1992), Numerical Solution of Stochastic Differential Equations, ch. 10.3.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> step = psf.Milstein(lambda x, r: [r * x[0]], lambda x, s: [[s * x[0]]], dt=0.01)
    >>> step.refined().substeps
    2
    """

    drift: Callable
    diffusion: Any = None
    _: KW_ONLY
    dt: float
    substeps: int = 1

    def __post_init__(self) -> None:
        check_needed(self.diffusion, "Milstein")
        super().__post_init__()

    def noise_size(self, values: Values) -> int:
        """Number of standard normals that one step of length ``dt`` uses; checks the diffusion."""
        _check_no_levy_areas(self._diffusion(values), values["x"])
        return super().noise_size(values)

    def advance(self, now: Values, noise: TensorVariable, length: float) -> TensorVariable:
        """The state after a substep."""
        x, diffusion = now["x"], self._diffusion(now)
        moved = x + length * self._drift(now) + (root_of(length) * diffusion) @ noise
        if x not in ancestors([diffusion]):
            return moved
        for j in range(diffusion.type.shape[1]):
            column = diffusion[:, j]
            weight = 0.5 * length * (noise[j] ** 2 - 1.0)
            moved = moved + weight * _along(column, x, column)
        return moved

    def linear_in_noise(self) -> EulerMaruyama:
        """The integrator for filters that linearise a step in its noise."""
        return EulerMaruyama(self.drift, self.diffusion, self.dt, self.substeps)


def _along(column: TensorVariable, x: TensorVariable, direction: TensorVariable) -> TensorVariable:
    """Derivative of a vector along a direction."""
    gradients = (
        pytensor.grad(column[i], x, disconnected_inputs="ignore", return_disconnected="zero")
        for i in range(column.type.shape[0])
    )
    return pt.stack([pt.sum(gradient * direction) for gradient in gradients])


def _check_no_levy_areas(diffusion: TensorVariable, x: TensorVariable) -> None:
    """Raise if a noise acts on a state that the column of another noise depends on."""
    m = diffusion.type.shape[1]
    if m == 1 or x not in ancestors([diffusion]):
        return
    acts, depends = _structure(diffusion, x)
    for j in range(m):
        for k in range(m):
            shared = np.flatnonzero(depends[:, j] & acts[:, k])
            if j != k and len(shared):
                raise ModelError(
                    f"diffusion must be diagonal noise or a single column in Milstein, got noise "
                    f"{j} that depends on state {shared[0]}, on which noise {k} acts: that needs "
                    "Levy areas. Use EulerMaruyama, or transform the states so that each depends "
                    "on its own noise only"
                )


def _structure(
    diffusion: TensorVariable, x: TensorVariable
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where noise j acts on state i, and where column j depends on state i, both (n, m).

    Decided by trial at random points, because parameters may have any range.
    """
    n, m = diffusion.type.shape
    roots = [v for v in graph_inputs([diffusion]) if isinstance(v, TensorVariable) and v is not x]
    symbols = [x, *(v for v in roots if not isinstance(v, Constant | SharedVariable))]
    evaluate = pytensor.function(symbols, diffusion, mode="FAST_COMPILE", on_unused_input="ignore")
    rng = np.random.default_rng(0)
    acts, depends = np.zeros((2, n, m), dtype=bool)
    with np.errstate(all="ignore"):
        for trial in range(N_TRIALS):
            # Half of the points are positive: a square root may be of a state or of a parameter.
            point = [np.asarray(rng.normal(size=v.type.shape)) for v in symbols]
            point = [np.abs(v) if trial % 2 else v for v in point]
            here = evaluate(*point)
            acts |= here != 0
            for i in range(n):
                moved = point[0].copy()
                moved[i] *= 1.5
                there = evaluate(moved, *point[1:])
                depends[i] |= ((here != there) & ~(np.isnan(here) & np.isnan(there))).any(axis=0)
    return acts, depends
