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
        return _given(mean, cov, C, R, steps, data, rows)
    n = A.shape[0]
    out = GaussianStates(np.empty((rows.size, n)), np.zeros((rows.size, n, rows.size, n)))
    for i, row in enumerate(rows):
        known = steps < row if moment == "predicted" else steps <= row
        found = _given(mean, cov, C, R, steps[known], data[known], [row])
        out.mean[i], out.cov[i, :, i] = found.mean[0], found.cov[0, :, 0]
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


def _given(mean, cov, C, R, steps, data, rows):
    """The states at the rows given the observations at these steps."""
    n_rows, n = len(rows), mean.shape[1]
    seen = np.isfinite(data.ravel())
    of_data = np.einsum("pi,jikl->jpkl", C, cov[steps])  # Cov(observation j, state k)
    among_data = np.einsum("jpkl,ql->jpkq", of_data[:, :, steps], C)
    size = seen.size
    S = among_data.reshape(size, size) + np.kron(np.eye(steps.size), R)
    cross = of_data[:, :, rows].reshape(size, n_rows * n)[seen]
    gain = np.linalg.solve(S[np.ix_(seen, seen)], cross).T
    residual = (data - mean[steps] @ C.T).ravel()[seen]
    prior = cov[rows][:, :, rows].reshape(n_rows * n, n_rows * n)
    return GaussianStates(
        mean[rows] + (gain @ residual).reshape(n_rows, n),
        (prior - gain @ cross).reshape(n_rows, n, n_rows, n),
    )
