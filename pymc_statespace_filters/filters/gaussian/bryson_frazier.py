"""States given all observations, by adjoints: no forecast covariance is inverted.

Modified Bryson-Frazier smoother (Bierman 1973, "Fixed interval smoothing with discrete
measurements"). With the forecast's mean m and covariance P, the innovation y of covariance S, the
gain K and C = I - K H, an adjoint vector and matrix go back over the record from zero:

    at an observation    l <- C' l - H' S^-1 y        L <- C' L C + H' S^-1 H
    over a step          l <- F' l                    L <- F' L F

and the smoothed law is N(m - P l, P - P L P), with (m, P) and (l, L) both after the observation of
the step, or both before it. Nothing is divided by but S, so noise on the velocity alone, or a start
that is known, are as good as any. The price is a difference: a variance that the data shrink by
ten orders of magnitude keeps half of its digits.

A whole path is drawn by simulation smoothing (Durbin and Koopman 2002, "A simple and efficient
simulation smoother"): simulate a path and its record, and move the path by the difference of what
the two records say. Of the simulated path only the filter's error e = x - m matters,

    at the start    e ~ N(0, P)
    over a step     e <- F e + B q
    at an observation, where y+ = H e + v,  v ~ N(0, R),    e <- e - K y+

and the path drawn is m + e - P l*, where l* is the adjoint l of the innovations y - y+. Before the
smoothing, m + e is a draw of N(m, P), and no square root of P was taken.

F, B and H are Jacobians at the filter's own means: exact for linear systems, otherwise the extended
smoother, and the path a draw from the system that is linear around the filter's means.
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
    """The functions of the smoother that belongs to a Gaussian filter.

    The vector ``s`` is the filter's, then the simulated error (n,); the adjoint ``s_bar`` is l, the
    lower triangle of L, then l*. ``Z`` holds the noises of each step in its columns: q, then
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
        """The filter beside a simulated error of it.

        * ``start(c, X, member) -> s``; the columns of ``X`` are errors at the start.
        * ``predict(c, inputs, k, t, s, Z, member) -> s``.
        * ``update(c, inputs, k, t, d, s, Z, member) -> (s, term)``.
        """
        recursion, n = self.recursion, self.recursion.system.n
        start_error = pt.tensor("x", dtype="float64", shape=(n,))
        (start,) = recursion.start.graph.outputs
        (forecast,) = recursion.predict.graph.outputs
        analysis, term = recursion.update.graph.outputs
        given = {"theta": self._symbols["theta"], "x": start_error}
        whole = Graph(given, [pt.concatenate([start, start_error])])
        moved = [pt.concatenate([forecast, self._moved_error()])]
        seen = [pt.concatenate([analysis, self._seen_error()]), term]
        return {
            "parameters": recursion.parts()["parameters"],
            "start": VectorFunction("c, X, member", whole),
            "predict": self._function("c, inputs, k, t, s, Z, member", "theta u t s z", moved),
            "update": self._function(
                "c, inputs, k, t, d, s, Z, member", "theta u t d s z", seen, False, True
            ),
        }

    def backwards(self) -> dict[str, VectorFunction]:
        """The adjoints, and what they say of a state; states are read from rows of a tape.

        * ``end(c) -> s_bar``.
        * ``unpredict(c, inputs, k, t, tape, row, s_bar) -> s_bar``, the tape before the step.
        * ``unupdate(c, inputs, k, t, d, tape, row, Z, member, s_bar) -> s_bar``, the tape before
          the observation.
        * ``smooth(c, tape, row, s_bar) -> (mean, variances, drawn)``.
        """
        theta = self._symbols["theta"]
        nothing = Graph({"theta": theta}, [pt.zeros((self.size,))])
        return {
            "parameters": self.recursion.parts()["parameters"],
            "end": VectorFunction("c", nothing),
            "unpredict": self._function(
                "c, inputs, k, t, tape, row, s_bar", "theta u t tape s_bar", [self._unmoved()]
            ),
            "unupdate": self._function(
                "c, inputs, k, t, d, tape, row, Z, member, s_bar",
                "theta u t d tape z s_bar",
                [self._unseen()],
            ),
            "smooth": self._function(
                "c, tape, row, s_bar", "theta tape s_bar", self._smoothed(), False, False, False
            ),
        }

    def _function(
        self, arguments: str, names: str, outputs: Sequence[TensorVariable], *scalar: bool
    ) -> VectorFunction:
        """Outputs that were written in the filter's ``s`` and an error, as a function of both."""
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

    def _moved_error(self) -> TensorVariable:
        system, (mean, _) = self.recursion.system, self._moments()
        move = linearize_transition(system, self._symbols, mean)
        moved = move.state_jac @ self._error
        return moved + move.noise_jac @ self._z[: system.m] if system.m else moved

    def _sight(self) -> tuple[Innovation, TensorVariable]:
        """The linearised observation, and the innovation y+ of the simulated record.

        Where nothing was seen y+ is noise alone, which the gain and H leave out.
        """
        system = self.recursion.system
        sight = innovation_moments(system, self._symbols, *self._moments())
        noise = cholesky(sight.noise_cov, lower=True) @ self._z[system.m :]
        return sight, sight.seen_jac @ self._error + noise

    def _seen_error(self) -> TensorVariable:
        sight, innovation = self._sight()
        return self._error - sight.gain @ innovation

    def _unmoved(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        back = linearize_transition(
            self.recursion.system, self._symbols, self._moments()[0]
        ).state_jac.T
        return pt.concatenate([pack(back @ vector, back @ matrix @ back.T), back @ drawn])

    def _unseen(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        sight, simulated = self._sight()
        back = sight.kept.T

        def whitened(rows: TensorVariable, b_ndim: int) -> TensorVariable:
            """S^-1/2 times rows."""
            return solve_triangular(sight.chol, rows, lower=True, b_ndim=b_ndim)

        half = whitened(sight.seen_jac, 2)  # H' S^-1 y = (S^-1/2 H)' (S^-1/2 y)
        vector = back @ vector - half.T @ whitened(sight.residual, 1)
        drawn = back @ drawn - half.T @ whitened(sight.residual - simulated, 1)
        return pt.concatenate([pack(vector, back @ matrix @ back.T + half.T @ half), drawn])

    def _smoothed(self) -> list[TensorVariable]:
        (mean, cov), (vector, matrix, drawn) = self._moments(), self._adjoints()
        variances = pt.diagonal(cov) - pt.sum((cov @ matrix) * cov, axis=1)
        return [mean - cov @ vector, variances, mean + self._error - cov @ drawn]
