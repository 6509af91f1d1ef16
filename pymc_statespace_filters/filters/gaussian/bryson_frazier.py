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

F, B and H are those of the filter's linearisation: Jacobians at its means, or regressions over its
states, where B q is drawn from the covariance of the step's noise, with what the regression leaves.
For linear systems the result is exact; otherwise it is the extended smoother or the one by sigma
points, and the path is a draw from the linearised system.
"""

from collections.abc import Mapping

import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...compiler.codegen.semidefinite import semidefinite_root
from ...compiler.codegen.simd import LaneFunction
from .functions import GaussianFilterFunctions, covariances_at
from .linearization import Linearizations, Symbols, innovation_of, pack, unpack


class BrysonFrazier:
    """The functions of the smoother of a Gaussian filter.

    The vector ``s`` is the filter's, followed by the simulated error (n,); the adjoint ``s_bar`` is
    l, the lower triangle of L, and l*. ``z`` is the noise of one step: q if ``draws_q``, standard
    normals for each state otherwise, then standard normals for v. ``covariances`` are those to
    check, and those of the initial state and of q, if it is drawn.
    """

    def __init__(self, recursion: GaussianFilterFunctions, by: Linearizations) -> None:
        self.recursion = recursion
        system, size = recursion.system, recursion.size
        graphs = (recursion.start, recursion.predict, recursion.update)
        self._symbols: Symbols = {name: v for g in graphs for name, v in g.inputs.items()}
        self.size = size + system.n
        vector = {"dtype": "float64", "shape": (self.size,)}
        self._whole, self._adjoint = pt.tensor("s", **vector), pt.tensor("s_bar", **vector)
        self._error = pt.tensor("error", dtype="float64", shape=(system.n,))
        before = by.transition.state(*self._moments())
        self._step = by.transition.transition(system, self._symbols, before)
        self._state_jac = before.by_state(self._step.jac)
        forecast = by.observation.state(*self._moments())
        self._seen = by.observation.observation(system, self._symbols, forecast)
        self._observation_jac = forecast.by_state(self._seen.jac)
        self._innovation = innovation_of(forecast, self._seen)
        self._update_jac = pt.eye(system.n) - self._innovation.gain @ self._observation_jac
        self.draws_q = self._step.noise_jac is not None
        self.n_noises = system.m if self.draws_q else system.n
        drawn = ("initial_cov", "process_noise") if self.draws_q else ("initial_cov",)
        self.covariances = covariances_at(system, self._symbols["theta"], drawn)
        self._z = pt.tensor("z", dtype="float64", shape=(self.n_noises + system.p,))

    def functions(self) -> dict[str, LaneFunction]:
        """The filter with a simulated error of it, the adjoint recursion, and smoothed moments.

        * ``start``: theta, x -> s; x is an error of the initial state.
        * ``predict``: theta, u, t, s, z -> s.
        * ``update``: theta, u, t, d, s, z -> s, term.
        * ``predict_back``: theta, u, t, s, s_bar -> s_bar, with s before the step.
        * ``update_back``: theta, u, t, d, s, z, s_bar -> s_bar, with s before the observation.
        * ``smooth``: theta, s, s_bar -> mean, variances and drawn state, one vector.
        """
        recursion, n = self.recursion, self.recursion.system.n
        start_error = pt.tensor("x", dtype="float64", shape=(n,))
        (start,) = recursion.start.outputs
        (forecast,) = recursion.predict.outputs
        analysis, term = recursion.update.outputs
        given = {"theta": self._symbols["theta"], "x": start_error}
        started = Graph(given, [pt.concatenate([start, start_error]), self.covariances.values])
        predicted = pt.concatenate([forecast, self._predicted_error()])
        updated = pt.concatenate([analysis, self._updated_error()])
        smoothed = pt.concatenate(self._smoothed())
        of = self._function
        return {
            "start": LaneFunction(started, ["s", "cov"]),
            "predict": of("theta u t s z", {"s": predicted}),
            "update": of("theta u t d s z", {"s": updated, "term": term}),
            "predict_back": of("theta u t s s_bar", {"s_bar": self._predict_adjoint()}),
            "update_back": of("theta u t d s z s_bar", {"s_bar": self._update_adjoint()}),
            "smooth": of("theta s s_bar", {"moments": smoothed}),
        }

    def _function(self, names: str, outputs: Mapping[str, TensorVariable]) -> LaneFunction:
        """A function of the extended ``s``; the outputs are in terms of the filter's and error."""
        size, s = self.recursion.size, self._symbols["s"]
        parts = {s: self._whole[:size], self._error: self._whole[size:]}
        local = {"s": self._whole, "s_bar": self._adjoint, "z": self._z}
        inputs = {name: local.get(name, self._symbols.get(name)) for name in names.split()}
        whole = graph_replace(list(outputs.values()), parts, strict=False)
        return LaneFunction(Graph(inputs, whole), list(outputs))

    def _moments(self) -> tuple[TensorVariable, TensorVariable]:
        return unpack(self._symbols["s"], self.recursion.system.n)

    def _adjoints(self) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
        size = self.recursion.size
        return *unpack(self._adjoint[:size], self.recursion.system.n), self._adjoint[size:]

    def _predicted_error(self) -> TensorVariable:
        error, noise = self._state_jac @ self._error, self._z[: self.n_noises]
        if self._step.noise_cov is None:
            return error
        noise_jac = self._step.noise_jac
        return (
            error + (noise_jac if self.draws_q else semidefinite_root(self._step.noise_cov)) @ noise
        )

    def _simulated(self) -> TensorVariable:
        """The innovation y+ of the simulated record.

        For a missing component it is pure noise, which the gain and H multiply by zero.
        """
        noise = cholesky(self._seen.noise_cov, lower=True) @ self._z[self.n_noises :]
        return self._observation_jac @ self._error + noise

    def _updated_error(self) -> TensorVariable:
        return self._error - self._innovation.gain @ self._simulated()

    def _predict_adjoint(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        back = self._state_jac.T
        return pt.concatenate([pack(back @ vector, back @ matrix @ back.T), back @ drawn])

    def _update_adjoint(self) -> TensorVariable:
        vector, matrix, drawn = self._adjoints()
        back, residual = self._update_jac.T, self._seen.residual

        def whitened(rows: TensorVariable, b_ndim: int) -> TensorVariable:
            """S^-1/2 times rows."""
            return solve_triangular(self._innovation.chol, rows, lower=True, b_ndim=b_ndim)

        half = whitened(self._observation_jac, 2)  # H' S^-1 y = (S^-1/2 H)' (S^-1/2 y)
        vector = back @ vector - half.T @ whitened(residual, 1)
        drawn = back @ drawn - half.T @ whitened(residual - self._simulated(), 1)
        return pt.concatenate([pack(vector, back @ matrix @ back.T + half.T @ half), drawn])

    def _smoothed(self) -> list[TensorVariable]:
        (mean, cov), (vector, matrix, drawn) = self._moments(), self._adjoints()
        variances = pt.diagonal(cov) - pt.sum((cov @ matrix) * cov, axis=1)
        return [mean - cov @ vector, variances, mean + self._error - cov @ drawn]
