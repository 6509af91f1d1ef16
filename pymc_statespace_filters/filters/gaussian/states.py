"""Compiled state estimates of a Gaussian filter: predicted, filtered, smoothed, and the run.

Predicted and filtered states take one forward pass, smoothed states a backward pass too. The
forward pass leaves two tapes with a state per row: ``before`` each observation, and ``after`` each
step with its observation, if there is one.
"""

from dataclasses import dataclass

import numpy as np
import pytensor.tensor as pt

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
    jit,
)
from pymc_statespace_filters.compiler.codegen.functions import (
    copy_elements,
    vector_functions,
)
from pymc_statespace_filters.compiler.lowering.covariances import (
    covariance_check,
    semidefinite_cholesky,
)
from pymc_statespace_filters.compiler.lowering.symbols import call
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.numerics.normals import BLOCK, FILL_NORMALS
from pymc_statespace_filters.compiler.numerics.philox import STATES
from pymc_statespace_filters.filters.gaussian.bryson_frazier import BrysonFrazier
from pymc_statespace_filters.filters.gaussian.linearization import Linearization
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped_to_the_end,
    compiled_of,
)
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    is_missing,
)

# Counters of the random stream `STATES`: the steps of the record (one column each), the start.
_ALONG, _AT_START = 0, 1


@dataclass(frozen=True, eq=False)
class ForwardPass:
    """The forward pass, compiled once for a system and used for all moments."""

    smoother: BrysonFrazier
    noise: CompiledFunction
    forwards: CompiledFunction


def forward_pass(recursion: GaussianFilterFunctions, linearization: Linearization) -> ForwardPass:
    """The forward pass of a filter with a simulated error of it."""
    smoother = BrysonFrazier(recursion, linearization)
    return ForwardPass(smoother, _noise(smoother), _forwards(smoother))


def compile_states(forward: ForwardPass, moment: str) -> CompiledFunction:
    """The function (.., rows, draw_seed) -> (mean, sd, drawn, n_effective, health)."""
    recursion = forward.smoother.recursion
    if moment == "smoothed":
        read_states = _read_backwards(forward.smoother)
    else:
        read_states = _read_forwards(recursion.system.n, predicted=moment == "predicted")
    parts = {"noise": forward.noise, "forwards": forward.forwards, "read": read_states}
    noise, forwards, read = (part.function for part in parts.values())
    n = recursion.system.n

    def states(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        mean = np.full((rows.size, n), np.nan)
        sd, drawn = mean.copy(), mean.copy()
        n_effective = np.full(rows.size, np.nan)
        n_steps = steps[-1] if steps.size else np.int64(0)
        X, Z = noise(theta, n_steps, draw_seed)
        before, after, end, health = forwards(theta, steps, observed, inputs, t0, X, Z)
        record = (theta, steps, observed, inputs, t0, Z)
        n_rows = read(record, before, after, end, rows, mean, sd, drawn)
        n_effective[:n_rows] = np.inf
        return mean, sd, drawn, n_effective, health

    return compiled_of(states, f"states {moment}", parts, recursion)


def compile_run(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

    Means and covariances are read from the tape of the forward pass; a run without members.
    """
    forward = compile_taped_to_the_end(recursion)
    run_forward, n = forward.function, recursion.system.n

    def run(theta, steps, observed, inputs, t0, seed, rows):
        terms, health, tape = run_forward(theta, steps, observed, inputs, t0, seed)
        R, j = rows.size, 0
        mean, cov = np.empty((R, n)), np.empty((R, n, n))
        for r in range(R):
            while j < steps.size and steps[j] <= rows[r]:
                j += 1
            s = tape[rows[r] + j]  # the tape has a row for each step and each observation so far
            at = n
            for a in range(n):
                mean[r, a] = s[a]
                for b in range(a + 1):
                    cov[r, a, b] = cov[r, b, a] = s[at]
                    at += 1
        return terms, health, mean, cov, np.empty((R, 0, n)), np.empty((R, 0))

    return compiled_of(run, "run", {"forward": forward}, recursion)


def _forwards(smoother: BrysonFrazier) -> CompiledFunction:
    """The filter and a simulated error of it along a record.

    ``end``, the third result, is the first step without a state.
    """
    system, size = smoother.recursion.system, smoother.size
    parts = vector_functions(smoother.forwards())
    parameters, start, predict, update = (part.function for part in parts.values())
    valid = covariance_check(system)
    has_valid_covariances, dt, n = valid.function, system.dt, system.n

    def forwards(theta, steps, observed, inputs, t0, X, Z):
        n_steps = steps[-1] if steps.size else np.int64(0)
        before, after = np.empty((steps.size, size)), np.empty((n_steps + 1, size))
        health = np.array([np.inf, float(NONE), -1.0])
        if not has_valid_covariances(theta):
            health[1], health[2] = COVARIANCE_NOT_POSITIVE, 0.0
            return before, after, 0, health
        c = parameters(theta)
        s = start(c, X, 0)
        k = 0
        for j in range(steps.size):
            while k < steps[j]:
                for i in range(size):
                    after[k, i] = s[i]
                s = predict(c, inputs, k, t0 + k * dt, s, Z, k)
                k += 1
            has_mean = finite = True
            for i in range(size):
                before[j, i] = s[i]
                finite &= np.isfinite(s[i])
                has_mean &= i >= n or np.isfinite(s[i])
            if is_missing(observed, j):
                continue
            s, term = update(c, inputs, k, t0 + k * dt, observed[j], s, Z, k)
            if not (finite and np.isfinite(term)):
                health[1] = COVARIANCE_NOT_POSITIVE if has_mean else NO_FINITE_MEMBER
                health[2] = j
                return before, after, k, health
        for i in range(size):
            after[k, i] = s[i]
        return before, after, n_steps + 1, health

    key = key_of(
        __name__,
        __name__,
        f"forwards {dt!r} {n}",
        valid.key,
        *(part.key for part in parts.values()),
    )
    return CompiledFunction(jit(forwards), key)


def _read_forwards(n: int, *, predicted: bool) -> CompiledFunction:
    """Write predicted or filtered states at the rows; return how many rows have a state."""
    size = n + n * (n + 1) // 2

    def read(record, before, after, end, rows, mean, sd, drawn):
        steps = record[1]
        j = 0
        for r in range(rows.size):
            k = rows[r]
            if k >= end:
                return r
            s = after[k]
            while j < steps.size and steps[j] < k:
                j += 1
            if predicted and j < steps.size and steps[j] == k:
                s = before[j]
            for i in range(n):
                mean[r, i] = s[i]
                sd[r, i] = np.sqrt(max(s[n + i * (i + 3) // 2], 0.0))
                drawn[r, i] = s[i] + s[size + i]
        return rows.size

    return CompiledFunction(jit(read), key_of(__name__, f"read forwards {n} {predicted}"))


def _read_backwards(smoother: BrysonFrazier) -> CompiledFunction:
    """Write smoothed states at the rows; none if the filter failed."""
    system = smoother.recursion.system
    parts = vector_functions(smoother.backwards())
    parameters, end_of, predict_adjoint, update_adjoint, smooth = (
        part.function for part in parts.values()
    )
    dt, n = system.dt, system.n

    def read(record, before, after, end, rows, mean, sd, drawn):
        theta, steps, observed, inputs, t0, Z = record
        n_steps = after.shape[0] - 1
        if end <= n_steps:
            return 0
        c = parameters(theta)
        s_bar = end_of(c)
        j, r = steps.size - 1, rows.size - 1
        informed = False  # until an observation the adjoint is zero, even if Jacobians are infinite
        for k in range(n_steps, -1, -1):
            if r < 0:
                break
            if informed:
                s_bar = predict_adjoint(c, inputs, k, t0 + k * dt, after, k, s_bar)
            if rows[r] == k:
                m, variances, x = smooth(c, after, k, s_bar)
                for i in range(n):
                    mean[r, i], drawn[r, i] = m[i], x[i]
                    sd[r, i] = np.sqrt(max(variances[i], 0.0))
                r -= 1
            if j >= 0 and steps[j] == k:
                if not is_missing(observed, j):
                    s_bar = update_adjoint(
                        c, inputs, k, t0 + k * dt, observed[j], before, j, Z, k, s_bar
                    )
                    informed = True
                j -= 1
        return rows.size

    key = key_of(__name__, f"read backwards {dt!r} {n}", *(part.key for part in parts.values()))
    return CompiledFunction(jit(read), key)


def _noise(smoother: BrysonFrazier) -> CompiledFunction:
    """``noise(theta, n_steps, draw_seed)``: X (n, 1) ~ N(0, P_0), and Z (noises + p, steps).

    If the smoother draws q, the first m rows of Z have its covariance. The covariances may be
    singular; that they are covariances at theta has been checked.
    """
    system, m = smoother.recursion.system, smoother.n_noises
    equations, n = system.equations, system.n
    is_white = equations.process_noise is None or not smoother.draws_q
    theta = pt.tensor("theta", shape=(system.n_theta,), dtype="float64")
    covs = [call(equations.initial_cov, system, {"theta": theta})]
    if not is_white:
        covs.append(call(equations.process_noise, system, {"theta": theta}))
    graph = Graph({"theta": theta}, [pt.concatenate([cov.ravel() for cov in covs])])
    flat = vector_functions({"covariances": VectorFunction("c", graph)})["covariances"]
    covariances, n_rows = flat.function, m + system.p
    n_values = graph.outputs[0].type.shape[0]
    copy = copy_elements("found, values", "values[{i}]", "found", n_values)
    FILL_NORMALS.compile()
    fill, purpose = FILL_NORMALS.external, np.int64(STATES)

    def noise(theta, n_steps, draw_seed):
        width = BLOCK * (n_steps // BLOCK + 1)  # a column for each step, padded to whole blocks
        X, Z = np.empty((n, BLOCK)), np.empty((n_rows, width))
        fill(draw_seed, purpose, _AT_START, 0, X.ctypes.data, n, BLOCK)
        fill(draw_seed, purpose, _ALONG, 0, Z.ctypes.data, n_rows, width)
        values = np.empty(n_values)
        copy(covariances(theta), values)
        apply_covariance(values, 0, n, X)
        if not is_white:
            apply_covariance(values, n * n, m, Z)
        return X, Z

    key = key_of(
        __name__,
        __name__,
        f"noise of states {n} {m} {n_rows} {is_white}",
        flat.key,
        FILL_NORMALS.key,
    )
    return CompiledFunction(jit(noise), key)


@jit
def apply_covariance(values, first, size, Z):
    """Multiply ``size`` rows of standard normals by the root of the covariance in ``values``."""
    root = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            root[i, j] = values[first + i * size + j]
    semidefinite_cholesky(root)
    for i in range(size - 1, -1, -1):  # last row first: a row depends on itself and those above
        for member in range(Z.shape[1]):
            total = 0.0
            for j in range(i + 1):
                total += root[i, j] * Z[j, member]
            Z[i, member] = total
