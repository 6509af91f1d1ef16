"""Exact log-likelihood of linear-Gaussian systems, to test filters.

A filter must reproduce it exactly (the extended Kalman filter) or in the limit of many members (all
others). The code is the textbook covariance form of the Kalman filter: slow, short, and independent
of the package's compiled code.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import ModelError

Array = NDArray[np.float64]


def kalman_log_likelihood(
    transition_matrix: ArrayLike,
    process_cov: ArrayLike,
    observation_matrix: ArrayLike,
    observation_cov: ArrayLike,
    initial_mean: ArrayLike,
    initial_cov: ArrayLike,
    *,
    steps: ArrayLike,
    observed: ArrayLike,
    forcing: ArrayLike | None = None,
) -> Array:
    r"""Exact log-likelihood terms of a linear-Gaussian state-space model.

    The model is :math:`x_{k+1} = A x_k + b_k + w_k` with :math:`w_k \sim N(0, Q)` for every step,
    and :math:`d_j = C x_{d(j)} + e_j` with :math:`e_j \sim N(0, R)` at the steps :math:`d(j)`,
    where :math:`x_0 \sim N(m_0, P_0)`. The second argument of N is a covariance. The terms follow
    from thesis, Eqs. 4.5-4.7, 4.10-4.11 and 4.14, which are exact for this model.

    Parameters
    ----------
    transition_matrix : array_like, shape (n, n)
        A.
    process_cov : array_like, shape (n, n)
        Q, the covariance of the process noise of one step; may be singular. Noise that enters as
        ``B q`` with covariance S of q has ``Q = B @ S @ B.T``.
    observation_matrix : array_like, shape (p, n)
        C.
    observation_cov : array_like, shape (p, p)
        R.
    initial_mean : array_like, shape (n,)
        Mean of the state at step 0.
    initial_cov : array_like, shape (n, n)
        Covariance of the state at step 0; may be singular.
    steps : array_like of int, shape (J,)
        The steps d(j), strictly increasing, the first at 0 or later. An observation at step 0 is an
        update before any prediction.
    observed : array_like, shape (J, p) or (J,) if p is 1
        The observations; NaN marks a missing component.
    forcing : array_like, shape (K, n), K >= d(J), optional
        Row k is added to the state during the transition from step k to step k + 1.

    Returns
    -------
    ndarray, shape (J,)
        ``log p(d_j | d_1 .. d_{j-1})``; 0 for a row that is entirely missing. Their sum is the
        log-likelihood.

    Raises
    ------
    ModelError
        If shapes disagree, steps do not increase, or `forcing` has too few rows.

    Examples
    --------
    A random walk with unit steps, observed with unit noise at steps 0 and 2:

    >>> from pymc_statespace_filters.testing import kalman_log_likelihood
    >>> terms = kalman_log_likelihood(
    ...     [[1.0]], [[1.0]], [[1.0]], [[1.0]], [0.0], [[1.0]], steps=[0, 2], observed=[0.3, -0.1]
    ... )
    >>> terms.round(6).tolist()
    [-1.288012, -1.554249]
    """
    A, Q, C, R, x, P = (
        np.asarray(a, dtype=np.float64)
        for a in (
            transition_matrix,
            process_cov,
            observation_matrix,
            observation_cov,
            initial_mean,
            initial_cov,
        )
    )
    _check_shapes(A, Q, C, R, x, P)
    steps, observed, forcing = _check_record(steps, observed, forcing, n=x.size, p=len(C))

    terms = np.zeros(len(steps))
    now = 0
    for j, step in enumerate(steps):
        for k in range(now, step):
            x = A @ x + forcing[k]
            P = A @ P @ A.T + Q
        now = step
        seen = ~np.isnan(observed[j])
        if seen.any():
            terms[j], x, P = _update(x, P, C[seen], R[np.ix_(seen, seen)], observed[j, seen])
    return terms


def _update(x: Array, P: Array, C: Array, R: Array, d: Array) -> tuple[float, Array, Array]:
    """Log predictive density of d, and mean and covariance of the state given d."""
    residual = d - C @ x
    S = C @ P @ C.T + R
    K = np.linalg.solve(S, C @ P).T
    _, log_det = np.linalg.slogdet(2.0 * np.pi * S)
    term = -0.5 * (log_det + residual @ np.linalg.solve(S, residual))
    P = P - K @ S @ K.T
    return term, x + K @ residual, 0.5 * (P + P.T)


def _check_shapes(A: Array, Q: Array, C: Array, R: Array, x: Array, P: Array) -> None:
    if x.ndim != 1 or C.ndim != 2:
        raise ModelError(
            "initial_mean must be a vector and observation_matrix a matrix, "
            f"got shapes {x.shape} and {C.shape}"
        )
    n, p = x.size, len(C)
    expected = {
        "transition_matrix": (A, (n, n)),
        "process_cov": (Q, (n, n)),
        "observation_matrix": (C, (p, n)),
        "observation_cov": (R, (p, p)),
        "initial_cov": (P, (n, n)),
    }
    for name, (value, shape) in expected.items():
        if value.shape != shape:
            raise ModelError(f"{name} must have shape {shape}, got {value.shape}")


def _check_record(
    steps: ArrayLike, observed: ArrayLike, forcing: ArrayLike | None, *, n: int, p: int
) -> tuple[NDArray[np.int64], Array, Array]:
    steps = np.asarray(steps)
    if steps.ndim != 1 or not np.issubdtype(steps.dtype, np.integer):
        raise ModelError(f"steps must be a vector of integers, got {steps!r}")
    if (steps < 0).any() or (np.diff(steps) <= 0).any():
        raise ModelError(f"steps must be non-negative and strictly increasing, got {steps!r}")
    observed = np.asarray(observed, dtype=np.float64)
    if observed.ndim == 1 and p == 1:
        observed = observed[:, None]
    if observed.shape != (len(steps), p):
        raise ModelError(f"observed must have shape {(len(steps), p)}, got {observed.shape}")
    n_transitions = int(steps[-1]) if len(steps) else 0
    if forcing is None:
        forcing = np.zeros((n_transitions, n))
    forcing = np.asarray(forcing, dtype=np.float64)
    if forcing.ndim != 2 or forcing.shape[1] != n or len(forcing) < n_transitions:
        raise ModelError(
            f"forcing must have at least {n_transitions} rows of {n}, got shape {forcing.shape}"
        )
    return steps.astype(np.int64), observed, forcing
