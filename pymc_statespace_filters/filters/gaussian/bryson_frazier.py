"""Smoothed states of a Gaussian filter by adjoints, without inverting a forecast covariance.

Modified Bryson-Frazier smoother (Bierman 1973, "Fixed interval smoothing with discrete
measurements"). With the forecast's mean m and covariance P, the innovation y of covariance S, the
gain K and C = I - K H, an adjoint vector and matrix run backward over the record from zero:

    at an observation    l <- C' l - H' S^-1 y        L <- C' L C + H' S^-1 H
    over a step          l <- F' l                    L <- F' L F

and the smoothed distribution is N(m - P l, P - P L P), with (m, P) and (l, L) both after the
observation of the step, or both before it. S is the only divisor, so process noise on the velocity
alone and a known initial state need no special case. The cost is cancellation: a variance that the
data reduce by ten orders of magnitude keeps half of its digits.

A path is drawn by simulation smoothing (Durbin and Koopman 2002, "A simple and efficient simulation
smoother"): simulate a path and its record, then shift the path by the difference of the two
smoothed means. Of the simulated path only the filter's error e = x - m is needed,

    at the start    e ~ N(0, P)
    over a step     e <- F e + B q
    at an observation, where y+ = H e + v,  v ~ N(0, R),    e <- e - K y+

and the path drawn is m + e - P l*, where l* is the adjoint l of the innovations y - y+. Without the
backward pass, m + e is a draw from N(m, P), obtained without a square root of P.

F, B and H are Jacobians at the filter's means. For linear systems the result is exact; otherwise it
is the extended smoother, and the path is a draw from the system linearised around those means.
"""

from collections.abc import Sequence

import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import Graph, VectorFunction
from pymc_statespace_filters.filters.gaussian.linearization import (
    Innovation,
    Symbols,
    innovation_moments,
    linearize_transition,
    pack,
    unpack,
)
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions


class BrysonFrazier:
    """The functions of the smoother of a Gaussian filter.

    The vector ``s`` is the filter's, followed by the simulated error (n,); the adjoint ``s_bar`` is
    l, the lower triangle of L, and l*. A column of ``Z`` holds the noise of one step: q, then
    standard normals for v.
    """

    def __init__(self, recursion: GaussianFilterFunctions) -> None:
        self.recursion = recursion
        system, size = recursion.system, recursion.size
        graphs = (recursion.start.graph, recursion.predict.graph, recursion.update.graph)
        self._symbols: Symbols = {name: v for g in graphs for name, v in g.inputs.items()}
        self.size = size + system.n
        vector = {"dtype": "float64", "shape": (self.size,)}
        self._whole, self._adjoint = pt.tensor("s", **vector), pt.tensor("s_bar", **vector)
        self._error = pt.tensor("error", dtype="float64", shape=(system.n,))
        self._z = pt.tensor("z", dtype="float64", shape=(system.m + system.p,))

    def forwards(self) -> dict[str, VectorFunction]:
        """The filter together with a simulated error of it.

        * ``start(c, X, member) -> s``; the columns of ``X`` are errors of the initial state.
        * ``predict(c, inputs, k, t, s, Z, member) -> s``.
        * ``update(c, inputs, k, t, d, s, Z, member) -> (s, term)``.
        """
        recursion, n = self.recursion, self.recursion.system.n
        start_error = pt.tensor("x", dtype="float64", shape=(n,))
        (start,) = recursion.start.graph.outputs
        (forecast,) = recursion.predict.graph.outputs
        analysis, term = recursion.update.graph.outputs
        given = {"theta": self._symbols["theta"], "x": start_error}
        started = Graph(given, [pt.concatenate([start, start_error])])
        predicted = [pt.concatenate([forecast, self._predicted_error()])]
        updated = [pt.concatenate([analysis, self._updated_error()]), term]
        return {
            "parameters": recursion.parts()["parameters"],
            "start": VectorFunction("c, X, member", started),
            "predict": self._function("c, inputs, k, t, s, Z, member", "theta u t s z", predicted),
            "update": self._function(
                "c, inputs, k, t, d, s, Z, member", "theta u t d s z", updated, False, True
            ),
        }

    def backwards(self) -> dict[str, VectorFunction]:
        """The adjoint recursion and the smoothed moments; states are read from rows of a tape.

        * ``end(c) -> s_bar``.
        * ``predict_adjoint(c, inputs, k, t, tape, row, s_bar) -> s_bar``; the row is the state
          before the step.
        * ``update_adjoint(c, inputs, k, t, d, tape, row, Z, member, s_bar) -> s_bar``; the row is
          the state before the observation.
        * ``smooth(c, tape, row, s_bar) -> (mean, variances, drawn)``.
        """
        theta = self._symbols["theta"]
        zeros = Graph({"theta": theta}, [pt.zeros((self.size,))])
        return {
            "parameters": self.recursion.parts()["parameters"],
            "end": VectorFunction("c", zeros),
            "predict_adjoint": self._function(
                "c, inputs, k, t, tape, row, s_bar",
                "theta u t tape s_bar",
                [self._predict_adjoint()],
            ),
            "update_adjoint": self._function(
                "c, inputs, k, t, d, tape, row, Z, member, s_bar",
                "theta u t d tape z s_bar",
                [self._update_adjoint()],
            ),
            "smooth": self._function(
                "c, tape, row, s_bar", "theta tape s_bar", self._smoothed(), False, False, False
            ),
        }

    def _function(
        self, arguments: str, names: str, outputs: Sequence[TensorVariable], *scalar: bool
    ) -> VectorFunction:
        """A function of the extended ``s``; the outputs are in terms of the filter's and error."""
        size, s = self.recursion.size, self._symbols["s"]
        parts = {s: self._whole[:size], self._error: self._whole[size:]}
        local = {"s": self._whole, "tape": self._whole, "s_bar": self._adjoint, "z": self._z}
        inputs = {name: local.get(name, self._symbols.get(name)) for name in names.split()}
        whole = graph_replace(list(outputs), parts, strict=False)
        return VectorFunction(arguments, Graph(inputs, whole), scalar or (False,))

    def _moments(self) -> tuple[TensorVariable, TensorVariable]:
        return unpack(self._symbols["s"], self.recursion.system.n)

    def _adjoints(self) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
        size = self.recursion.size
        return *unpack(self._adjoint[:size], self.recursion.system.n), self._adjoint[size:]

    def _predicted_error(self) -> TensorVariable:
        system, (mean, _) = self.recursion.system, self._moments()
        transition = linearize_transition(system, self._symbols, mean)
        error = transition.state_jac @ self._error
        return error + transition.noise_jac @ self._z[: system.m] if system.m else error

    def _innovation(self) -> tuple[Innovation, TensorVariable]:
        """The linearised observation, and the innovation y+ of the simulated record.

        For a missing component y+ is pure noise, which the gain and H multiply by zero.
        """
        system = self.recursion.system
        innovation = innovation_moments(system, self._symbols, *self._moments())
        noise = cholesky(innovation.noise_cov, lower=True) @ self._z[system.m :]
        return innovation, innovation.observation_jac @ self._error + noise

    def _updated_error(self) -> TensorVariable:
        innovation, simulated = self._innovation()
        return self._error - innovation.gain @ simulated

    def _predict_adjoint(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        mean, _ = self._moments()
        back = linearize_transition(self.recursion.system, self._symbols, mean).state_jac.T
        return pt.concatenate([pack(back @ vector, back @ matrix @ back.T), back @ drawn])

    def _update_adjoint(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        innovation, simulated = self._innovation()
        back = innovation.update_jac.T

        def whitened(rows: TensorVariable, b_ndim: int) -> TensorVariable:
            """S^-1/2 times rows."""
            return solve_triangular(innovation.chol, rows, lower=True, b_ndim=b_ndim)

        half = whitened(innovation.observation_jac, 2)  # H' S^-1 y = (S^-1/2 H)' (S^-1/2 y)
        vector = back @ vector - half.T @ whitened(innovation.residual, 1)
        drawn = back @ drawn - half.T @ whitened(innovation.residual - simulated, 1)
        return pt.concatenate([pack(vector, back @ matrix @ back.T + half.T @ half), drawn])

    def _smoothed(self) -> list[TensorVariable]:
        (mean, cov), (vector, matrix, drawn) = self._moments(), self._adjoints()
        variances = pt.diagonal(cov) - pt.sum((cov @ matrix) * cov, axis=1)
        return [mean - cov @ vector, variances, mean + self._error - cov @ drawn]
