"""Whether a model's integration steps are stable, and its log-density with steps half as long."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.symbols import call, jacobian_of, symbols_of
from pymc_statespace_filters.compiler.native.interpreted import interpreted_at_points
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.ekf import EKF
from pymc_statespace_filters.filters.protocol import Filter
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.pymc_model.inspection import likelihood_nodes
from pymc_statespace_filters.system.accumulators import without_resets
from pymc_statespace_filters.system.model import StateSpaceModel

MAX_STEPS = 500
STEPS_PER_JACOBIAN = 10

Array = NDArray[np.float64]


def densities_by_steps(model: pm.Model) -> tuple[TensorVariable, TensorVariable] | None:
    """A model's log-density with its integration steps, and with steps half as long.

    Both use deterministic filters: the EKF where it can treat the system, else the filter of the
    variable. None if no variable has an integrator, or if one has no deterministic filter.
    """
    log_density = model.logp()
    coarse: dict[Variable, Variable] = {}
    fine: dict[Variable, Variable] = {}
    nodes = likelihood_nodes([log_density])
    if not any(node.op.system.integrator for node in nodes):
        return None
    for node in nodes:
        system = refined = node.op.system
        if system.integrator is not None:
            refined = system.with_integrator(system.integrator.refined())
        filter = _deterministic_filter(system, refined, node.op.filter)
        if filter is None:
            return None
        for replaced, version in ((coarse, system), (fine, refined)):
            outputs = LogLikelihood(version, filter)(*node.inputs)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
    return clone_replace(log_density, coarse), clone_replace(log_density, fine)


def step_stability(model: pm.Model) -> Callable[[Array], NDArray[np.bool_]] | None:
    """Whether the steps of all integrators in a model are stable along the path without noise.

    The returned function takes points of the joined value variables, shape (m, k), and returns
    booleans of shape (m,). None if no variable has an integrator.
    """
    nodes = [n for n in likelihood_nodes([model.logp()]) if n.op.system.integrator is not None]
    if not nodes:
        return None
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    # theta, steps, inputs and t0, but not data and seed.
    needed = [node.inputs[i] for node in nodes for i in (0, 1, 3, 4)]
    outputs, joined = join_nonshared_inputs(model.initial_point(), needed, values)
    record = compile_pymc([joined], outputs, mode="FAST_COMPILE")

    def is_stable(x: Array) -> NDArray[np.bool_]:
        columns = [np.stack(column) for column in zip(*map(record, x), strict=True)]
        stable = np.ones(len(x), dtype=bool)
        for i, node in enumerate(nodes):
            system = node.op.system
            eigenvalues = path_eigenvalues(system, *columns[4 * i : 4 * i + 4])
            stable &= system.integrator.is_stable_at(eigenvalues).all(axis=1)
        return stable

    return is_stable


def path_eigenvalues(
    system: StateSpaceModel, theta: Array, steps: Array, inputs: Array, t0: Array
) -> NDArray[np.complex128]:
    """Eigenvalues (m, K, n) of the Jacobian of a substep at K states of the path without noise.

    It is that of the substep which the integrator names for this, if it names one. The arguments
    are those of the likelihood at m points. The path starts from the initial mean. Eigenvalues are
    NaN where the Jacobian is not finite.
    """
    assert system.integrator is not None
    single = system.with_integrator(system.integrator.substep())
    length, substeps = single.dt, round(system.dt / single.dt)
    start, advance, jacobian = _compile_path(single, _examined(system))
    if inputs.shape[1] == 0:  # a system without inputs
        inputs = np.zeros((len(theta), 1, system.n_input_columns))
    inputs = without_resets(system, inputs)  # which belong to a step, not to each substep
    x = start(theta)
    eigenvalues = []
    n_steps = min(int(steps.max(initial=0)) * substeps, MAX_STEPS)
    with np.errstate(all="ignore"):
        for k in range(n_steps + 1):
            now = theta, x, inputs[:, min(k // substeps, inputs.shape[1] - 1)], t0 + k * length
            if k % STEPS_PER_JACOBIAN == 0 or k == n_steps:
                eigenvalues.append(_eigenvalues(jacobian(*now)))
            x = advance(*now)
    return np.stack(eigenvalues, axis=1)


def _eigenvalues(jacobians: Array) -> NDArray[np.complex128]:
    found = np.full(jacobians.shape[:2], np.nan, dtype=complex)
    finite = np.isfinite(jacobians).all(axis=(1, 2))
    found[finite] = np.linalg.eigvals(jacobians[finite])
    return found


def _examined(system: StateSpaceModel) -> StateSpaceModel:
    """The system with the substep whose eigenvalues its integrator reads."""
    assert system.integrator is not None
    substep = system.integrator.substep()
    examined = getattr(substep, "examined_step", substep.substep)
    return system.with_integrator(examined())


def _compile_path(system: StateSpaceModel, examined: StateSpaceModel) -> list[Callable]:
    """Initial mean, next state, and Jacobian of the examined step, each for many points at once."""
    symbols = symbols_of(system)
    theta, now = symbols["theta"], [symbols[name] for name in ("theta", "x", "u", "t")]
    values = dict(zip(("theta", "x", "u", "t"), now, strict=True))
    advanced = call(system.equations.transition, system, values)
    start = call(system.equations.initial_mean, system, {"theta": theta})
    seen = call(examined.equations.transition, examined, values)
    graphs = [([theta], start), (now, advanced), (now, jacobian_of(seen, values["x"]))]
    return [interpreted_at_points(arguments, output) for arguments, output in graphs]


def _deterministic_filter(
    system: StateSpaceModel, refined: StateSpaceModel, filter_of_variable: Filter
) -> Filter | None:
    """A deterministic filter that can treat both systems."""
    candidates: tuple[Any, ...] = (EKF(), filter_of_variable)
    for filter in candidates:
        try:
            filter.check(compile_system(system))
            filter.check(compile_system(refined))
        except ModelError:
            continue
        if not filter.noisy:
            return filter
    return None
