"""A system without noise whose start is known: the state is a function of the parameters.

It has no covariance, so a Gaussian filter is a run of the equations. No observation moves the state
and each has the density p(d | x), of any kind: the likelihood is exact. The vector ``s`` of the
filter is the state.
"""

import numpy as np
import pytensor.tensor as pt

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
)
from pymc_statespace_filters.compiler.lowering.gaussian import differentiable_log_density
from pymc_statespace_filters.compiler.lowering.symbols import call, symbols_of
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped_to_the_end,
    compiled_of,
)
from pymc_statespace_filters.system.model import StateSpaceModel


def filter_functions(system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of a Gaussian filter for a system without any spread."""
    values = symbols_of(system)
    del values["q"]  # zero
    values["s"] = values.pop("x").type("s")
    state = {**values, "x": values["s"]}

    def function(arguments: str, inputs: str, outputs: list, *scalar: bool) -> VectorFunction:
        graph = Graph({name: values[name] for name in inputs.split()}, outputs)
        return VectorFunction(arguments, graph, scalar)

    start = call(system.equations.initial_mean, system, values)
    step = call(system.equations.transition, system, state)
    # A copy: the derivative of the term by s would be lost beside s itself as an output.
    seen = [pt.tensor_copy(values["s"]), pt.atleast_1d(differentiable_log_density(system, state))]
    return GaussianFilterFunctions(
        system,
        # Measured for Runge-Kutta steps: explicit rows take 45 % longer than propagation.
        False,
        function("c", "theta", [start], False),
        function("c, inputs, k, t, s", "theta u t s", [step], False),
        function("c, inputs, k, t, d, s", "theta u t d s", seen, False, True),
    )


def compile_run(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run with covariance 0."""
    path = _path(recursion)
    run_path, n = path.function, recursion.system.n

    def run(theta, steps, observed, inputs, t0, seed, rows):
        terms, health, mean = run_path(theta, steps, observed, inputs, t0, seed, rows)
        cov = np.zeros((rows.size, n, n))
        cov[np.isnan(mean[:, 0])] = np.nan
        return terms, health, mean, cov, np.empty((rows.size, 0, n)), np.empty((rows.size, 0))

    return compiled_of(run, "deterministic run", {"path": path}, recursion)


def compile_states(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (.., rows, draw_seed) -> (mean, sd, drawn, n_effective, health).

    Predicted, filtered and smoothed states are the same.
    """
    path = _path(recursion)
    run_path = path.function

    def states(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        _, health, mean = run_path(theta, steps, observed, inputs, t0, seed, rows)
        n_effective = np.full(rows.size, np.inf)
        n_effective[np.isnan(mean[:, 0])] = np.nan
        return mean, 0.0 * mean, mean.copy(), n_effective, health

    return compiled_of(states, "deterministic states", {"path": path}, recursion)


def _path(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """Terms, health and the states at rows; from a failing observation on these are NaN."""
    forward = compile_taped_to_the_end(recursion)
    run_forward, n = forward.function, recursion.system.n

    def path(theta, steps, observed, inputs, t0, seed, rows):
        terms, health, tape = run_forward(theta, steps, observed, inputs, t0, seed)
        states = np.full((rows.size, n), np.nan)
        j = 0
        for r in range(rows.size):
            while j < steps.size and steps[j] <= rows[r]:
                j += 1
            states[r] = tape[rows[r] + j]
        return terms, health, states

    return compiled_of(path, "deterministic path", {"forward": forward}, recursion)
