"""Restoring forces of worn and ageing structures (thesis, Section 5.3.1).

Freeplay and hysteresis are sums of ramps ``max(z, 0)``. With `width` the kink of a ramp becomes a
polynomial bend, which makes these forces smooth in the displacement.
"""

from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike
from pytensor import config
from pytensor.tensor import TensorVariable

from ..errors import ModelError

__all__ = ["cubic", "freeplay", "hysteresis", "hysteresis_branch"]

type Tensorlike = TensorVariable | ArrayLike
type Coefficient = TensorVariable | np.ndarray | float


def cubic(z: Tensorlike, k_l: Coefficient, k_nl: Coefficient) -> TensorVariable:
    """Force of a spring with linear and cubic stiffness.

    .. math:: f_c = k_l z + k_{nl} z^3

    A positive `k_nl` makes the spring harden with displacement, a negative one makes it soften.

    Parameters
    ----------
    z : tensor_like
        Displacement.
    k_l, k_nl : tensor_like
        Linear and cubic stiffness, of any shapes that broadcast with `z`.

    Returns
    -------
    TensorVariable
        The force, of the broadcast shape.

    References
    ----------
    Thesis, Eq. 5.20.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.mechanics.cubic(2.0, k_l=1.0, k_nl=0.5).eval()
    array(6.)
    """
    z = _real(z)
    return k_l * z + k_nl * z**3


def freeplay(
    z: Tensorlike, k_f: Coefficient, delta_f: Coefficient, *, width: float | None = None
) -> TensorVariable:
    r"""Force of a spring with a gap, such as a worn hinge or a loose rivet.

    .. math::

        f_f = \begin{cases} k_f (z - \delta_f) & z > \delta_f \\
                            0 & -\delta_f \le z \le \delta_f \\
                            k_f (z + \delta_f) & z < -\delta_f \end{cases}

    Parameters
    ----------
    z : tensor_like
        Displacement.
    k_f : tensor_like
        Stiffness outside the gap.
    delta_f : tensor_like
        Half the gap, not negative.
    width : float, optional
        Length over which each of the two kinks is smoothed, centred on the kink. Farther than
        ``width / 2`` from a kink the force is exact; the error is at most
        ``3 / 32 * k_f * width``. The smoothed force has two continuous derivatives, so a
        likelihood that uses its Jacobian is differentiable. None keeps the kinks.

    Returns
    -------
    TensorVariable
        The force, of the broadcast shape of the arguments.

    Raises
    ------
    ModelError
        If `width` is not a positive, finite number.

    References
    ----------
    Thesis, Eq. 5.21.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.mechanics.freeplay([-0.5, 0.1, 0.5], k_f=2.0, delta_f=0.2).eval()
    array([-0.6, 0. , 0.6])
    """
    z, width = _real(z), _check_width(width)
    return k_f * (_ramp(z - delta_f, width) - _ramp(-z - delta_f, width))


def hysteresis(
    z: Tensorlike,
    v: Tensorlike,
    k_h: Coefficient,
    a_h: Coefficient,
    delta_h: Coefficient,
    *,
    width: float | None = None,
) -> TensorVariable:
    r"""Force of a hysteretic spring: one branch for rising, another for falling displacement.

    With :math:`f_0 = k_h (2 a_h + \delta_h) / 2` the rising branch, :math:`v \ge 0`, is

    .. math::

        f_h = \begin{cases} k_h (z - a_h) + f_0 & z < a_h \\
                            f_0 & a_h \le z \le a_h + \delta_h \\
                            k_h (z - a_h - \delta_h) + f_0 & z > a_h + \delta_h \end{cases}

    and the falling branch, :math:`v < 0`, is its mirror image, :math:`-f_h(-z)`. Beyond
    :math:`|z| = a_h + \delta_h` both are the line :math:`k_h (z - \delta_h / 2)` for positive and
    :math:`k_h (z + \delta_h / 2)` for negative `z`. A full cycle dissipates the energy
    :math:`2 f_0 \delta_h`.

    Parameters
    ----------
    z, v : tensor_like
        Displacement and velocity.
    k_h : tensor_like
        Stiffness outside the plateaus.
    a_h, delta_h : tensor_like
        Start and length of a plateau, not negative.
    width : float, optional
        Length over which each kink in `z` is smoothed, as in :func:`freeplay`; the error is at most
        ``3 / 32 * k_h * width``. The jump between the branches at ``v = 0``, of height up to
        ``k_h * delta_h``, is not smoothed, because `width` is a displacement and not a velocity.
        The derivative by `v` is therefore zero wherever it exists. None keeps the kinks.

    Returns
    -------
    TensorVariable
        The force, of the broadcast shape of the arguments.

    Raises
    ------
    ModelError
        If `width` is not a positive, finite number.

    Notes
    -----
    The force has no memory: the branch depends on the sign of the velocity alone. Between the
    plateaus, ``abs(z) < a_h``, the force is that of a spring with dry friction of strength
    ``k_h * delta_h / 2``, which holds the mass in place if the other forces are weaker. For a force
    that keeps its branch when the motion turns inside the loop, pass the branch from
    :func:`hysteresis_branch` as `v`: only the sign counts.

    *Differences from the source.* "Positive deflection" is read as positive velocity: with the sign
    of the displacement there would be no loop. A velocity of exactly zero is on the rising branch.

    References
    ----------
    Thesis, Eqs. 5.22 and 5.23.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.mechanics.hysteresis(0.0, [1.0, -1.0], k_h=1.0, a_h=0.5, delta_h=1.5).eval()
    array([ 0.75, -0.75])
    """
    z, v, width = _real(z), _real(v), _check_width(width)
    f_0 = k_h * (2 * a_h + delta_h) / 2

    def rising(z: TensorVariable) -> TensorVariable:
        return f_0 + k_h * (_ramp(z - a_h - delta_h, width) - _ramp(a_h - z, width))

    return pt.switch(v >= 0, rising(z), -rising(-z))


def hysteresis_branch(
    z: Tensorlike, branch: Tensorlike, a_h: Coefficient, delta_h: Coefficient
) -> TensorVariable:
    r"""Branch of a hysteresis with memory, which changes only at the ends of the loop.

    .. math::

        b' = \begin{cases} -1 & z \ge a_h + \delta_h \\
                            +1 & z \le -(a_h + \delta_h) \\
                            b & \text{between} \end{cases}

    Beyond the ends both branches are the same line, so the force ``hysteresis(z, b, ...)`` is
    continuous. A motion that turns inside the loop returns along its branch, without friction.

    Parameters
    ----------
    z : tensor_like
        Displacement.
    branch : tensor_like
        The current branch: 1 is the rising one, -1 the falling one.
    a_h, delta_h : tensor_like
        Start and length of a plateau, as in :func:`hysteresis`.

    Returns
    -------
    TensorVariable
        The new branch, of the broadcast shape of the arguments.

    Notes
    -----
    In a `StateSpaceModel` the branch is a separate state, named in ``carried`` because no Kalman
    update may change it. `EKF` and `GridFilter` refuse such a system.

    *Difference from the source.* Thesis, Eqs. 5.22 and 5.23 do not say when the branch changes.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.mechanics.hysteresis_branch([-2.5, 0.0, 2.5], 1.0, a_h=0.5, delta_h=1.5).eval()
    array([ 1.,  1., -1.])
    """
    z, end = _real(z), a_h + delta_h
    return pt.switch(z >= end, -1.0, pt.switch(z <= -end, 1.0, _real(branch)))


def _ramp(z: TensorVariable, width: float | None) -> TensorVariable:
    """``max(z, 0)``; with `width` its slope is the smoothstep ``3 s^2 - 2 s^3``, not a step."""
    if width is None:
        return pt.switch(z > 0, z, 0.0)
    s = z / width + 0.5
    bend = width * s**3 * (1 - s / 2)
    return pt.switch(s <= 0, 0.0, pt.switch(s >= 1, z, bend))


def _real(value: Tensorlike) -> TensorVariable:
    """Cast to PyTensor's float type, because powers of small integer types overflow."""
    return pt.cast(pt.as_tensor_variable(value), config.floatX)


def _check_width(width: Any) -> float | None:
    if width is None or (isinstance(width, int | float) and 0 < width < np.inf):
        return width
    raise ModelError(f"width must be a positive, finite number or None, got {width!r}")
