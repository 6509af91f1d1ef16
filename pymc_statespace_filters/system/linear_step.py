"""The matrices of an exact step of a linear equation, as an operation on symbols.

For dx = (A x + b) dt + dW, where dW has the covariance S dt, over one unit of time:

    Phi = exp(A),    Q = int_0^1 exp(A s) S exp(A' s) ds,    c = int_0^1 exp(A s) b ds.

Taylor series give them for a time 2^-k so short that few terms are needed. Two steps make one of
twice the length,

    Q <- Q + Phi Q Phi',    c <- c + Phi c,    Phi <- Phi Phi,

k times. Nothing cancels, so a stiff equation, a singular A and a singular S need no special case.
The derivative is that of these operations, in reverse order.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.tensor.variable import TensorVariable

N_TERMS = 14  # of a series; the next is below rounding for the largest norm
LARGEST_NORM = 0.25
MAX_DOUBLINGS = 60


class LinearStepFunctions(NamedTuple):
    """``forward(given, n, out)`` and ``backward(given, bars, n, out)`` on flat arrays.

    ``given`` is A, S and b, ``out`` of forward is Phi, Q and c; ``bars`` and ``out`` of backward
    are cotangents of the latter and of the former, in this order.
    """

    forward: Callable
    backward: Callable


def make_functions(compiled: Callable) -> LinearStepFunctions:
    """The two functions and what they call, each passed through ``compiled``."""

    @compiled
    def add(a, b, factor, out):
        """out += factor a b."""
        for i in range(a.shape[0]):
            for k in range(a.shape[1]):
                for j in range(b.shape[1]):
                    out[i, j] += factor * a[i, k] * b[k, j]

    @compiled
    def increase(out, a):
        """out += a; numba takes seconds to compile it for arrays of any shapes."""
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                out[i, j] += a[i, j]

    @compiled
    def assign(out, a):
        """out = a; numba takes a second to compile ``out[:] = a``, for its message about shapes."""
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                out[i, j] = a[i, j]

    @compiled
    def add_left(a, b, factor, out):
        """out += factor a' b."""
        for k in range(a.shape[0]):
            for i in range(a.shape[1]):
                for j in range(b.shape[1]):
                    out[i, j] += factor * a[k, i] * b[k, j]

    @compiled
    def add_right(a, b, factor, out):
        """out += factor a b'."""
        for i in range(a.shape[0]):
            for j in range(b.shape[0]):
                for k in range(a.shape[1]):
                    out[i, j] += factor * a[i, k] * b[j, k]

    @compiled
    def n_doublings(given, n):
        """How often a step is halved; -1 where the equation is not finite."""
        norm = 0.0
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += abs(given[i * n + j])
            norm = max(norm, total)
        k = 0
        while norm > LARGEST_NORM and k < MAX_DOUBLINGS:
            norm *= 0.5
            k += 1
        for i in range(given.size):
            if not np.isfinite(given[i]):
                k = -1
        return k

    @compiled
    def read(flat, n, factor, matrix, symmetric, vector):
        """Two matrices and a vector from a flat array, the second matrix made symmetric."""
        for i in range(n):
            vector[i, 0] = factor * flat[2 * n * n + i]
            for j in range(n):
                matrix[i, j] = factor * flat[i * n + j]
                other = flat[n * n + i * n + j] + flat[n * n + j * n + i]
                symmetric[i, j] = 0.5 * factor * other

    @compiled
    def write(matrix, symmetric, vector, factor, out):
        n = matrix.shape[0]
        for i in range(n):
            out[2 * n * n + i] = factor * vector[i, 0]
            for j in range(n):
                out[i * n + j] = factor * matrix[i, j]
                out[n * n + i * n + j] = 0.5 * factor * (symmetric[i, j] + symmetric[j, i])

    @compiled
    def series(a, powers, spreads, shifts):
        """The terms of the three series; spreads[0] and shifts[0] are given."""
        for i in range(a.shape[0]):
            powers[0, i, i] = 1.0
        for m in range(1, N_TERMS):
            add(a, powers[m - 1], 1.0 / m, powers[m])
            add(a, spreads[m - 1], 1.0 / (m + 1), spreads[m])
            add_right(spreads[m - 1], a, 1.0 / (m + 1), spreads[m])
            add(a, shifts[m - 1], 1.0 / (m + 1), shifts[m])

    @compiled
    def double(phi, q, c, phi_after, q_after, c_after):
        half = np.zeros(phi.shape)
        add(phi, phi, 1.0, phi_after)
        add(phi, q, 1.0, half)
        increase(q_after, q)
        add_right(half, phi, 1.0, q_after)
        increase(c_after, c)
        add(phi, c, 1.0, c_after)

    @compiled
    def double_back(phi, q, c, phi_bar, q_bar, c_bar):
        """The cotangents before a doubling, in place of those after it."""
        before, half = np.zeros(phi.shape), np.zeros(phi.shape)
        add_right(phi_bar, phi, 1.0, before)
        add_left(phi, phi_bar, 1.0, before)
        add(q_bar, phi, 1.0, half)
        add(half, q, 2.0, before)
        add_right(c_bar, c, 1.0, before)
        assign(phi_bar, before)
        add_left(phi, half, 1.0, q_bar)
        copy = c_bar.copy()
        add_left(phi, copy, 1.0, c_bar)

    @compiled
    def series_back(a, powers, spreads, shifts, phi_bar, q_bar, c_bar, a_bar):
        """The cotangents of the first terms, in place of those of the sums."""
        power_bar, spread_bar, shift_bar = phi_bar.copy(), q_bar.copy(), c_bar.copy()
        for m in range(N_TERMS - 1, 0, -1):
            add_right(power_bar, powers[m - 1], 1.0 / m, a_bar)
            add(spread_bar, spreads[m - 1], 2.0 / (m + 1), a_bar)
            add_right(shift_bar, shifts[m - 1], 1.0 / (m + 1), a_bar)
            power_before, spread_before = phi_bar.copy(), q_bar.copy()
            shift_before = c_bar.copy()
            add_left(a, power_bar, 1.0 / m, power_before)
            add_left(a, spread_bar, 1.0 / (m + 1), spread_before)
            add(spread_bar, a, 1.0 / (m + 1), spread_before)
            add_left(a, shift_bar, 1.0 / (m + 1), shift_before)
            power_bar, spread_bar, shift_bar = power_before, spread_before, shift_before
        assign(q_bar, spread_bar)
        assign(c_bar, shift_bar)

    @compiled
    def run(given, n, k, a, powers, spreads, shifts, phi, q, c):
        """Terms of the series, and the matrices for each length, the shortest first."""
        read(given, n, 0.5**k, a, spreads[0], shifts[0])
        series(a, powers, spreads, shifts)
        for m in range(N_TERMS - 1, -1, -1):
            increase(phi[0], powers[m])
            increase(q[0], spreads[m])
            increase(c[0], shifts[m])
        for j in range(k):
            double(phi[j], q[j], c[j], phi[j + 1], q[j + 1], c[j + 1])

    @compiled
    def forward(given, n, out):
        k = n_doublings(given, n)
        if k < 0:
            out[:] = np.nan
            return
        a, powers, spreads = np.empty((n, n)), np.zeros((N_TERMS, n, n)), np.zeros((N_TERMS, n, n))
        shifts = np.zeros((N_TERMS, n, 1))
        phi, q, c = np.zeros((k + 1, n, n)), np.zeros((k + 1, n, n)), np.zeros((k + 1, n, 1))
        run(given, n, k, a, powers, spreads, shifts, phi, q, c)
        write(phi[k], q[k], c[k], 1.0, out)

    @compiled
    def backward(given, bars, n, out):
        k = n_doublings(given, n)
        if k < 0:
            out[:] = np.nan
            return
        a, powers, spreads = np.empty((n, n)), np.zeros((N_TERMS, n, n)), np.zeros((N_TERMS, n, n))
        shifts = np.zeros((N_TERMS, n, 1))
        phi, q, c = np.zeros((k + 1, n, n)), np.zeros((k + 1, n, n)), np.zeros((k + 1, n, 1))
        run(given, n, k, a, powers, spreads, shifts, phi, q, c)
        phi_bar, q_bar, c_bar = np.empty((n, n)), np.empty((n, n)), np.empty((n, 1))
        read(bars, n, 1.0, phi_bar, q_bar, c_bar)
        for j in range(k - 1, -1, -1):
            double_back(phi[j], q[j], c[j], phi_bar, q_bar, c_bar)
        a_bar = np.zeros((n, n))
        series_back(a, powers, spreads, shifts, phi_bar, q_bar, c_bar, a_bar)
        write(a_bar, q_bar, c_bar, 0.5**k, out)

    return LinearStepFunctions(forward, backward)


_FUNCTIONS = make_functions(lambda function: function)


class LinearStep(Op):
    """(A, S, b) -> (Phi, Q, c), both as flat vectors; see the module."""

    __props__ = ("n",)

    def __init__(self, n: int) -> None:
        self.n = n

    def make_node(self, given: Variable) -> Apply:  # noqa: D102
        return Apply(self, [given], [given.type()])

    def perform(self, node: Apply, inputs: list, output_storage: list) -> None:  # noqa: D102
        output_storage[0][0] = out = np.empty_like(inputs[0])
        with np.errstate(all="ignore"):
            _FUNCTIONS.forward(inputs[0], self.n, out)

    def pullback(self, inputs: list, outputs: list, cotangents: list) -> list:
        """By `LinearStepBack`."""
        return [LinearStepBack(self.n)(*inputs, *cotangents)]


class LinearStepBack(Op):
    """The cotangent of the input of `LinearStep`, from its input and the cotangent of its output.

    Its own derivative is not defined.
    """

    __props__ = ("n",)

    def __init__(self, n: int) -> None:
        self.n = n

    def make_node(self, given: Variable, bars: Variable) -> Apply:  # noqa: D102
        return Apply(self, [given, bars], [given.type()])

    def perform(self, node: Apply, inputs: list, output_storage: list) -> None:  # noqa: D102
        output_storage[0][0] = out = np.empty_like(inputs[0])
        with np.errstate(all="ignore"):
            _FUNCTIONS.backward(inputs[0], inputs[1], self.n, out)


def linear_step(
    a: TensorVariable, cov: TensorVariable, offset: TensorVariable, length: float
) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
    """Phi (n, n), Q (n, n) and c (n,) of a step of this length."""
    n = a.type.shape[0]
    given = length * pt.concatenate([a.ravel(), cov.ravel(), offset])
    found = LinearStep(n)(pt.specify_shape(given, (2 * n * n + n,)))
    phi = found[: n * n].reshape((n, n))
    return phi, found[n * n : 2 * n * n].reshape((n, n)), found[2 * n * n :]
