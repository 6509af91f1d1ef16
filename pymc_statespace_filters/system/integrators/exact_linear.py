"""Exact steps of a linear stochastic differential equation."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ..equations import Equation, as_matrix, as_vector, read_equation
from ..linear_step import linear_step
from .step_series import root_of_covariance, step_matrices
from .substeps import Values

# Of a step whose length is a symbol: exact to rounding up to a rate of 128 per step.
N_TERMS, DOUBLINGS = 12, 8


@dataclass(frozen=True)
class ExactLinear:
    r"""Exact steps of the linear equation :math:`dx = (A x + b)\,dt + B\,dW`, of any length.

    .. math::
        x_{k+1} = e^{A h} x_k + \int_0^h e^{A s} b\, ds + q_k, \qquad
        q_k \sim N\Bigl(0, \int_0^h e^{A s} B B^T e^{A^T s}\, ds\Bigr)

    with ``h = dt``. A step has no error, so there is nothing to refine. The matrices of a step are
    computed once per evaluation of a likelihood, not once per step, and have derivatives.

    Parameters
    ----------
    A : callable or array_like, shape (n, n)
        The matrix, or a function of parameters that returns it; it may be singular.
    B : callable or array_like, shape (n, m)
        One column per independent Wiener process, per square root of time, or a function of
        parameters that returns it. One state and one noise: a scalar.
    dt : float
        Length of one step, in the time unit of ``A``.
    offset : callable or array_like, shape (n,), optional
        The constant part ``b`` of the drift, or a function of parameters; default zero.

    Notes
    -----
    Series give the matrices of a short fraction of a step, and doublings those of the step, without
    cancellation: ``A`` and ``B B^T`` may be singular, and the equation may be stiff. A record at
    any times has steps of many lengths, whose matrices are computed at each step: that is meant for
    a few states, and exact to rounding up to rates of 128 per step.

    References
    ----------
    Van Loan (1978), Computing integrals involving the matrix exponential, has the same integrals by
    exponentials of block matrices.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> def oscillator(w, c):
    ...     return [[0.0, 1.0], [-w**2, -c]]
    >>> psf.ExactLinear(oscillator, [[0.0], [0.3]], dt=0.5).dt
    0.5
    """

    A: Any
    B: Any = None
    _: KW_ONLY
    dt: float
    offset: Any = None

    def __post_init__(self) -> None:
        for name in ("A", "B", "offset"):
            value = getattr(self, name)
            if value is not None and not callable(value):
                object.__setattr__(self, name, _constant(name, value))
        for name in ("A", "B"):
            if getattr(self, name) is None:
                raise ModelError(
                    f"{name} must be a matrix or a function of parameters, got None; B of zeros, "
                    "shape (n, 1), is an equation without noise"
                )
        _ = self.equations  # checks the functions

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The user's functions, in the order in which their parameters are listed."""
        named = {"A": self.A, "B": self.B, "offset": self.offset}
        return tuple(read_equation(name, f, "") for name, f in named.items() if callable(f))

    def noise_size(self, values: Values) -> int:
        """Number of noises of one step: one per state."""
        return values["x"].type.shape[0]

    def noise_cov(self, values: Values) -> TensorVariable:
        """Covariance of the noise of one step."""
        return self._matrices(values)[1]

    def step(self, values: Values) -> TensorVariable:
        """The state one step later, given the symbols ``x`` and ``q`` and the parameters."""
        phi, _, moved = self._matrices(values)
        drifted = phi @ values["x"]
        return (drifted if self.offset is None else drifted + moved) + values["q"]

    def substep(self) -> Self:
        """The integrator itself: a step is one."""
        return self

    def refined(self) -> Self:
        """The integrator itself: a step is exact, whatever its length."""
        return self

    def is_stable_at(self, eigenvalues: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """Whether the eigenvalues are finite: an exact step follows its equation."""
        return np.isfinite(eigenvalues).all(axis=-1)

    def _function(self, name: str, values: Values) -> Any:
        value = getattr(self, name)
        if not callable(value):
            return value
        (equation,) = (e for e in self.equations if e.role == name)
        return equation(values)

    def at_length(self, length: TensorVariable) -> "ExactLinearOfLength":
        """The same equation with steps of this length, a symbol."""
        return ExactLinearOfLength(self, length)

    def _matrices(self, values: Values) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
        """Transition matrix, covariance and offset of a step."""
        return linear_step(*self.linear_equation(values), self.dt)

    def linear_equation(
        self, values: Values
    ) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
        """A (n, n), B B^T (n, n) and the offset (n,)."""
        n = values["x"].type.shape[0]
        a = as_matrix("A", self._function("A", values), n, n)
        b = as_matrix("B", self._function("B", values), n)
        offset = np.zeros(n) if self.offset is None else self._function("offset", values)
        return a, b @ b.T, as_vector("offset", offset, n)


@dataclass(frozen=True)
class ExactLinearOfLength:
    """Steps of an `ExactLinear` of a length that is a symbol, by standard normals."""

    integrator: ExactLinear
    length: Any

    def step(self, values: Values) -> TensorVariable:
        """The state one step later."""
        a, spread, offset = self.integrator.linear_equation(values)
        phi, moved, cov = step_matrices(
            a, offset, spread, self.length, n_terms=N_TERMS, doublings=DOUBLINGS
        )
        assert cov is not None
        drifted = phi @ values["x"]
        drifted = drifted if self.integrator.offset is None else drifted + moved
        return drifted + root_of_covariance(cov) @ values["q"]


def _constant(name: str, value: Any) -> Any:
    """Numbers as nested tuples, because an integrator is hashable; a scalar as it is."""
    try:
        array = np.asarray(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(
            f"{name} must be numbers or a function of parameters, got {value!r}"
        ) from None
    if not np.isfinite(array).all():
        raise ModelError(f"{name} must be finite, got {value!r}")
    return _nested(array.tolist())


def _nested(value: Any) -> Any:
    return tuple(map(_nested, value)) if isinstance(value, Sequence) else value
