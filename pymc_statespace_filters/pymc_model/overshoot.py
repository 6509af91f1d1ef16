"""Whether the Euler-Maruyama steps of a system overshoot along its own path."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.replace import vectorize_graph

from pymc_statespace_filters.compiler.lowering.symbols import call, jacobian_of, symbols_of
from pymc_statespace_filters.system.model import StateSpaceModel

MAX_STEPS = 500
EVERY = 10  # steps between two Jacobians

Array = NDArray[np.float64]


def smallest_multiplier(
    system: StateSpaceModel, theta: Array, steps: Array, inputs: Array, t0: Array
) -> Array:
    """Smallest real part of an eigenvalue of the step's Jacobian, along the path without noise.

    A flow multiplies a small deviation by exp(a h), an Euler-Maruyama step by 1 + a h: where that
    is negative, the step overshoots.

    Parameters
    ----------
    system : StateSpaceModel
        With Euler-Maruyama steps.
    theta : ndarray (m, n_theta)
    steps : ndarray (m, J)
    inputs : ndarray (m, rows, n_inputs)
    t0 : ndarray (m,)
        Inputs of the likelihood, at m points. The path starts from the initial mean.

    Returns
    -------
    ndarray (m,)
        -inf where the path leaves the numbers.
    """
    substeps = system.integrator.substeps
    length = system.dt / substeps
    system = system.with_integrator(replace(system.integrator, dt=length, substeps=1))
    start, advance, jacobian = _compiled(system)
    if inputs.shape[1] == 0:  # nothing to hold, in a system without inputs
        inputs = np.zeros((len(theta), 1, system.n_inputs))
    x = start(theta)
    smallest = np.full(len(theta), np.inf)
    n_steps = min(int(steps.max(initial=0)) * substeps, MAX_STEPS)
    with np.errstate(all="ignore"):
        for k in range(n_steps + 1):
            now = theta, x, inputs[:, min(k // substeps, inputs.shape[1] - 1)], t0 + k * length
            if k % EVERY == 0 or k == n_steps:
                jac = jacobian(*now)
                bounded = np.isfinite(jac).all(axis=(1, 2))
                found = np.linalg.eigvals(jac[bounded]).real.min(axis=1)
                smallest[~bounded] = -np.inf
                smallest[bounded] = np.minimum(smallest[bounded], found)
            x = advance(*now)
    return smallest


def _compiled(system: StateSpaceModel) -> list[Callable]:
    """Initial mean, next state and Jacobian of the step, each of many points at once."""
    symbols = symbols_of(system)
    theta, now = symbols["theta"], [symbols[name] for name in ("theta", "x", "u", "t")]
    values = dict(zip(("theta", "x", "u", "t"), now, strict=True))
    advanced = call(system.equations.transition, system, values)
    start = call(system.equations.initial_mean, system, {"theta": theta})
    graphs = [([theta], start), (now, advanced), (now, jacobian_of(advanced, values["x"]))]
    compiled = []
    for arguments, output in graphs:
        batches = [pt.tensor(shape=(None, *a.type.shape), dtype="float64") for a in arguments]
        # A constant output, such as a given initial mean, is repeated by a term of zero.
        vectorised = vectorize_graph(output, dict(zip(arguments, batches, strict=True)))
        if vectorised.type.ndim == output.type.ndim:
            vectorised = vectorised + pt.zeros((batches[0].shape[0],) + (1,) * output.type.ndim)
        # A few thousand calls: not worth machine code.
        compiled.append(
            pytensor.function(batches, vectorised, mode="FAST_COMPILE", on_unused_input="ignore")
        )
    return compiled
