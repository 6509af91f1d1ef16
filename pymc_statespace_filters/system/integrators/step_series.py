"""The matrices of an exact step of a linear equation, as expressions.

They are those of `linear_step`, for steps whose equation or length changes from step to step.
Series give them for a short fraction of a step, and doublings those of the step.
"""

from typing import Any, NamedTuple

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

SMALLEST_PIVOT = 1e-13  # relative to the variance; below it is rounding of zero


class StepMatrices(NamedTuple):
    """exp(A h) (n, n), and the integrals of exp(A s) b (n,) and of exp(A s) S exp(A' s) (n, n).

    ``cov`` is None where there is no S.
    """

    phi: TensorVariable
    moved: TensorVariable
    cov: TensorVariable | None


def step_matrices(
    a: TensorVariable,
    b: TensorVariable,
    spread: TensorVariable | None,
    length: Any,
    *,
    n_terms: int,
    doublings: int,
) -> StepMatrices:
    """The matrices of dx = (A x + b) dt + dW, with the covariance S dt of dW, over a length."""
    short = length / 2**doublings
    phi, moved = _series(short * a, short * b, n_terms)
    cov = None if spread is None else _spread(short * a, short * spread, n_terms)
    for _ in range(doublings):
        moved = moved + phi @ moved
        cov = None if cov is None else cov + phi @ cov @ phi.T
        phi = phi @ phi
    return StepMatrices(phi, moved, cov)


def _series(
    a: TensorVariable, b: TensorVariable, n_terms: int
) -> tuple[TensorVariable, TensorVariable]:
    """exp(a), and the integral of exp(a s) b over a unit of time."""
    n = a.type.shape[0]
    power, moved = pt.eye(n), b
    for m in range(n_terms, 0, -1):
        power = pt.eye(n) + (a @ power) / m
        moved = b + (a @ moved) / (m + 1)
    return power, moved


def _spread(a: TensorVariable, cov: TensorVariable, n_terms: int) -> TensorVariable:
    """The integral of exp(a s) cov exp(a' s) over a unit of time."""
    term = total = cov
    for m in range(1, n_terms):
        half = a @ term
        term = (half + half.T) / (m + 1)
        total = total + term
    return total


def root_of_covariance(cov: TensorVariable) -> TensorVariable:
    """The lower root of a covariance; a column without spread is zero, and so is its derivative."""
    n = cov.type.shape[0]
    root: list[list[Any]] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = cov[j, j] - sum(root[j][k] ** 2 for k in range(j))
        has_spread = pivot > SMALLEST_PIVOT * cov[j, j]
        sd = pt.sqrt(pt.switch(has_spread, pivot, 1.0))
        root[j][j] = pt.switch(has_spread, sd, 0.0)
        for i in range(j + 1, n):
            rest = cov[i, j] - sum(root[i][k] * root[j][k] for k in range(j))
            root[i][j] = pt.switch(has_spread, rest / sd, 0.0)
    return pt.stack(
        [pt.stack([pt.as_tensor(entry, dtype="float64") for entry in row]) for row in root]
    )
