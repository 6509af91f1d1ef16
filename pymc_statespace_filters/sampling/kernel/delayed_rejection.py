"""Delayed rejection: the acceptance probability of any number of stages, in logs.

Let a chain be at ``y``. The first proposal ``z_1`` is rejected, so a second, ``z_2``, is made, that
may depend on both; and so on. The probability of accepting the i-th that keeps the chain reversible
is (thesis, Eq. 3.32)::

    alpha_i(y, z_1 .. z_i) = min(1, N_i / D_i),
    D_i = pi(y)   q_1(y, z_1)       q_2(y, z_1, z_2) ...         q_i(y, z_1 .. z_i)
                  [1 - alpha_1(y, z_1)] ...     [1 - alpha_{i-1}(y, z_1 .. z_{i-1})]
    N_i = pi(z_i) q_1(z_i, z_{i-1}) q_2(z_i, z_{i-1}, z_{i-2}) ... q_i(z_i .. y)
                  [1 - alpha_1(z_i, z_{i-1})] ... [1 - alpha_{i-1}(z_i .. z_1)]

Every factor belongs to a contiguous part of the path ``z_0 = y, z_1, .. z_i``, in forward or
backward direction, and N_i is D_i of the reversed path. So one table over the parts is enough:
with s and e the first and last point of a part, ``log_q[s, e]`` is the log-density of proposing z_e
as the stage ``|e - s|`` from z_s over the points between them, and ``log_acceptance`` fills the
table of log alpha from the short parts to the long ones. Nothing is assumed of the proposals: they
may be non-symmetric and depend on the whole path.

A tenth of the walks are of a smaller size, drawn for all stages together. A mixture of reversible
kernels is reversible. Such walks enter necks and leave corners where the adapted size is too large,
and where a chain would otherwise stand for hundreds of iterations.

The functions are compiled and pure: PyMC's step method and whole compiled chains call the same
code.

References
----------
A. Mira (2001). On Metropolis-Hastings algorithms with delayed rejection. Metron 59, 231-241.
P. J. Green and A. Mira (2001). Delayed rejection in reversible jump Metropolis-Hastings. Biometrika
88, 1035-1053.
"""

import numpy as np

from ...compiler.native.jit import linked

SMALL_SHARE = 0.1  # of the walks
SMALLEST = 0.01  # size of a walk, relative to the adapted one


@linked()
def log_acceptance(log_pi: np.ndarray, log_q: np.ndarray, stage: int) -> float:
    """Log-probability of accepting the proposal of a stage, thesis Eq. 3.32.

    A path that cannot occur (a point of zero probability, a proposal of zero density, an earlier
    proposal accepted with certainty) has the log-density minus infinity and needs no special
    treatment by the caller. If the path is impossible in both directions, the ratio is 0/0 and the
    proposal is rejected.

    Parameters
    ----------
    log_pi : ndarray, shape (stage + 1,) or longer
        Log-density of the target at z_0 .. z_stage, up to a constant. May be minus
        infinity, but not NaN or plus infinity.
    log_q : ndarray, shape (stage + 1, stage + 1) or larger
        Log-density of the proposals, ``log_q[s, e]`` as defined in the module docstring, up to one
        constant for each stage. The diagonal is not read.
    stage : int
        The stage, from 1.

    Returns
    -------
    float
        Log of the acceptance probability, in [-inf, 0].

    Examples
    --------
    One stage of a symmetric proposal is Metropolis' rule:

    >>> import numpy as np
    >>> from numba import njit
    >>> accept = njit(lambda log_pi, log_q: log_acceptance(log_pi, log_q, 1))
    >>> accept(np.array([0.0, -1.5]), np.zeros((2, 2)))
    -1.5
    """
    n_points = stage + 1
    log_alpha = np.zeros((n_points, n_points))
    # log D of every part: pi at its first point, every proposal, every rejection but the last.
    log_path = np.empty((n_points, n_points))
    for length in range(1, n_points):
        for start in range(n_points):
            for end in (start - length, start + length):
                if 0 <= end < n_points:
                    step = 1 if end > start else -1
                    before = log_pi[start]
                    if length > 1:
                        rejected = _log_one_minus_exp(log_alpha[start, end - step])
                        before = log_path[start, end - step] + rejected
                    log_path[start, end] = before + log_q[start, end]
        for start in range(n_points - length):
            end = start + length
            there, back = log_path[start, end], log_path[end, start]
            log_alpha[start, end] = log_ratio_to_one(back, there)
            log_alpha[end, start] = log_ratio_to_one(there, back)
    return log_alpha[0, stage]


@linked()
def gaussian_log_proposals(offsets: np.ndarray, stage_scale: float, stage: int) -> np.ndarray:
    """Table ``log_q`` of Gaussian stages centred at the current point.

    Stage k proposes N(y, g^(2(k-1)) C) with ``C = L L^T`` and ``g = stage_scale``. In coordinates
    ``w = L^-1 (z - y)`` this needs neither C nor its inverse; the constants of each stage cancel in
    Eq. 3.32. The densities are symmetric in their end points, and yet q_1(z_2, z_1) does not cancel
    against q_1(y, z_1).

    Parameters
    ----------
    offsets : ndarray, shape (stage + 1, d) or longer
        The points of the path as ``w``; the first row is zero.
    stage_scale : float
        Standard deviation of each stage relative to the one before it.
    stage : int
        The stage, from 1.

    Returns
    -------
    ndarray, shape (stage + 1, stage + 1)
        ``log_q[s, e]`` up to one constant for each ``|e - s|``.
    """
    log_q = np.zeros((stage + 1, stage + 1))
    for start in range(stage + 1):
        for end in range(start + 1, stage + 1):
            distance = 0.0
            for k in range(offsets.shape[1]):
                distance += (offsets[end, k] - offsets[start, k]) ** 2
            value = -0.5 * distance / stage_scale ** (2 * (end - start - 1))
            log_q[start, end] = value
            log_q[end, start] = value
    return log_q


@linked()
def gaussian_log_acceptance(
    log_pi: np.ndarray, offsets: np.ndarray, stage_scale: float, stage: int
) -> float:
    """``log_acceptance`` with the proposals of ``gaussian_log_proposals``."""
    if stage == 1:  # most calls: the symmetric proposal cancels
        return log_ratio_to_one(log_pi[1], log_pi[0])
    return log_acceptance(log_pi, gaussian_log_proposals(offsets, stage_scale, stage), stage)


@linked()
def log_ratio_to_one(log_numerator: float, log_denominator: float) -> float:
    """Log of min(1, N/D), with 0/0 = 0 and N/0 = 1."""
    if log_numerator == -np.inf:
        return -np.inf
    return min(0.0, log_numerator - log_denominator)


@linked()
def _log_one_minus_exp(log_p: float) -> float:
    """Log of 1 - p for a probability given by its log."""
    if log_p >= 0.0:
        return -np.inf
    if log_p > -0.6931471805599453:
        return np.log(-np.expm1(log_p))
    return np.log1p(-np.exp(log_p))


@linked()
def walk_size(uniform: float) -> float:
    """The size of a walk relative to the adapted one: 1, or log-uniform between `SMALLEST` and 1.

    Examples
    --------
    >>> walk_size.py_func(0.5)
    1.0
    >>> walk_size.py_func(0.05)
    0.1
    """
    return 1.0 if uniform >= SMALL_SHARE else SMALLEST ** (1.0 - uniform / SMALL_SHARE)
