"""States of a linear system given a record: one Gaussian vector of all steps, conditioned.

No recursion: the joint law of all states is written down, and the observations are conditioned on
in one solve. It is a check of the filters' and smoothers' recursions for that reason.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Moment = Literal["predicted", "filtered", "smoothed"]


class GaussianStates(NamedTuple):
    """Mean (R, n) and covariance (R, n, R, n) of the states at R steps.

    Only for the smoothed law are blocks of two different steps of use.
    """

    mean: Array
    cov: Array

    @property
    def sd(self) -> Array:
        """(R, n)."""
        R, n = self.mean.shape
        return np.sqrt(np.maximum(self.cov.reshape(R * n, R * n).diagonal(), 0.0)).reshape(R, n)


def linear_states(
    A: ArrayLike,
    Q: ArrayLike,
    C: ArrayLike,
    R: ArrayLike,
    m0: ArrayLike,
    P0: ArrayLike,
    *,
    steps: ArrayLike,
    observed: ArrayLike,
    rows: ArrayLike,
    moment: Moment,
    forcing: ArrayLike | None = None,
) -> GaussianStates:
    """Law of x at ``rows`` for x' = A x + f_k + N(0, Q), d = C x + N(0, R), x_0 ~ N(m0, P0).

    ``observed`` is (J, p), NaN missing component by component; ``forcing`` is (K, n).
    """
    A, Q, C, R, P0 = (np.atleast_2d(np.asarray(a, float)) for a in (A, Q, C, R, P0))
    steps, rows = np.asarray(steps), np.asarray(rows)
    mean, cov = _all_steps(A, Q, np.atleast_1d(m0), P0, max(steps[-1], rows[-1]) + 1, forcing)
    data = np.reshape(observed, (steps.size, C.shape[0]))
    if moment == "smoothed":
        mean, cov = _given(mean, cov, C, R, steps, data)
        return GaussianStates(mean[rows], cov[rows][:, :, rows])
    n = A.shape[0]
    out = GaussianStates(np.empty((rows.size, n)), np.zeros((rows.size, n, rows.size, n)))
    for i, row in enumerate(rows):
        known = steps < row if moment == "predicted" else steps <= row
        m, P = _given(mean, cov, C, R, steps[known], data[known])
        out.mean[i], out.cov[i, :, i] = m[row], P[row][:, row]
    return out


def _all_steps(A, Q, m0, P0, n_steps, forcing):
    """Mean (K, n) and covariance (K, n, K, n) of the states at all steps, before any datum."""
    n = A.shape[0]
    mean, cov = np.empty((n_steps, n)), np.empty((n_steps, n, n_steps, n))
    mean[0], cov[0, :, 0] = m0, P0
    for k in range(1, n_steps):
        push = 0.0 if forcing is None else np.reshape(forcing, (-1, n))[k - 1]
        mean[k] = A @ mean[k - 1] + push
        for earlier in range(k):
            cov[k, :, earlier] = A @ cov[k - 1, :, earlier]
            cov[earlier, :, k] = cov[k, :, earlier].T
        cov[k, :, k] = A @ cov[k - 1, :, k - 1] @ A.T + Q
    return mean, cov


def _given(mean, cov, C, R, steps, data):
    """Condition on the observations at these steps."""
    (K, n), p = mean.shape, C.shape[0]
    prior = cov.reshape(K * n, K * n)
    look = np.zeros((steps.size, p, K, n))
    look[np.arange(steps.size), :, steps] = C
    seen = np.isfinite(data.ravel())
    look = look.reshape(-1, K * n)[seen]
    noise = np.kron(np.eye(steps.size), R)[np.ix_(seen, seen)]
    gain = np.linalg.solve(look @ prior @ look.T + noise, look @ prior).T
    mean = mean.ravel() + gain @ (data.ravel()[seen] - look @ mean.ravel())
    return mean.reshape(K, n), (prior - gain @ look @ prior).reshape(K, n, K, n)
