"""Whether a model's integration steps are stable, and its log-density with steps half as long."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.symbols import call, jacobian_of, symbols_of
from ..compiler.native.rows import interpreted_at_points
from ..errors import ModelError
from ..ops.signatures import PANEL
from ..system.input_columns import divided, with_resets, without_events
from ..system.integrators.substeps import CoupledNoise
from ..system.model import StateSpaceModel
from ..system.panel_records import FIRST_INPUT, RECORD, STEP
from .at_points import GraphsAtPoints
from .inspection import likelihood_nodes, log_density_graph

MAX_STEPS = 500
STEPS_PER_JACOBIAN = 10
_ANY_FACTOR = np.array([[-1e9 + 0j]])

Array = NDArray[np.float64]


def densities_by_halvings(model: pm.Model, halvings: int) -> list[TensorVariable]:
    """A model's log-density with its integration steps, and with these halved 1, 2, ... times.

    Each variable keeps its filter. A noisy filter is replaced by its smooth version, whose estimate
    has the same mean, and all lengths of the step are driven by the same path of the noise, so that
    their estimates with one seed differ little.
    """
    density = log_density_graph(model)
    nodes = likelihood_nodes([density])
    if not any(node.op.system.integrator for node in nodes):
        raise ModelError(
            "model must have a StateSpace variable whose system has an integrator, such as "
            "EulerMaruyama, for its step to be halved, got "
            f"{[node.op.system for node in nodes] or 'none'}: a transition that is a function has "
            "no step to halve, and a system that was unpickled knows no integrator"
        )
    replaced: list[dict[Variable, Variable]] = [{} for _ in range(halvings + 1)]
    for node in nodes:
        if node.op.system.integrator is not None:
            for into, outputs in zip(replaced, _halved(node, halvings), strict=True):
                into |= dict(zip(node.outputs, outputs, strict=True))
    return [clone_replace(density, into) for into in replaced]


def step_lengths(model: pm.Model) -> list[float]:
    """The length of the substeps of every integrator of a model."""
    systems = [node.op.system for node in likelihood_nodes([log_density_graph(model)])]
    return [s.integrator.substep().dt for s in systems if s.integrator is not None]


def _halved(node: Any, halvings: int) -> list[list[Variable]]:
    """The outputs of a likelihood with its steps halved 0, 1, 2, ... times."""
    system, filter = node.op.system, node.op.filter
    integrators = [system.integrator]
    for _ in range(halvings):
        integrators.append(integrators[-1].refined())
    systems = [system.with_integrator(integrator) for integrator in integrators]
    if not filter.noisy:
        return [_likelihood(node, version) for version in systems]
    # Parameters drift once a step, whatever its substeps.
    noises = [one.m - len(one.drifting) for one in systems]
    if noises[0] and noises == [noises[0] * 2**i for i in range(halvings + 1)]:
        coupled = [
            CoupledNoise(integrator, 2 ** (halvings - i)) if i < halvings else integrator
            for i, integrator in enumerate(integrators)
        ]
        systems = [system.with_integrator(one, keeps_noises=True) for one in coupled]
    filter = filter.smooth(compile_system(systems[0]))
    for version in systems:
        filter.check(compile_system(version))
    return [node.op.of(version, filter)(*node.inputs) for version in systems]


def _likelihood(node: Any, system: StateSpaceModel) -> list[Variable]:
    """The outputs of a likelihood with other substeps, or with shorter steps in their place.

    A GridFilter takes noise that is added at the end of a step, and no substeps.
    """
    filter = node.op.filter
    try:
        filter.check(compile_system(system))
    except ModelError:
        return _with_shorter_steps(node, system)
    return node.op.of(system, filter)(*node.inputs)


def _with_shorter_steps(node: Any, system: StateSpaceModel) -> list[Variable]:
    """The outputs of a likelihood whose record is on the finer grid of the substeps of a system."""
    assert system.integrator is not None
    single = system.with_integrator(system.integrator.substep())
    factor = round(system.dt / single.dt)
    theta, steps, observed, inputs, *others = node.inputs
    node.op.filter.check(compile_system(single))
    rows = divided(system, inputs, factor)
    # The rows of a panel have a column of records before those of steps and inputs.
    factors = factor if steps.type.ndim == 1 else np.array([1, factor, factor])
    likelihood = node.op.of(single, node.op.filter)
    return likelihood(theta, steps * factors, observed, rows, *others)


def step_stability(model: pm.Model) -> Callable[[Array], NDArray[np.bool_]] | None:
    """Whether the steps of all integrators in a model are stable along the path without noise.

    The returned function takes points of the joined value variables, shape (m, k), and returns
    booleans of shape (m,). None if no variable has an integrator whose steps have an error.
    """

    def is_stable(system: StateSpaceModel, *arguments: Array) -> NDArray[np.bool_]:
        assert system.integrator is not None
        [eigenvalues] = path_eigenvalues([system], *arguments)
        return system.integrator.is_stable_at(eigenvalues).all(axis=1)

    along = _along_paths(model, is_stable)
    return None if along is None else lambda x: along(x).all(axis=1)


def step_accuracy(model: pm.Model) -> Callable[[Array], Array] | None:
    """How far steps half as long multiply small deviations by other factors; as `step_stability`.

    The largest difference of a factor of one step and of two half as long, along the path; of
    Euler-Maruyama steps the square of half the rate times the step.
    """

    def difference(system: StateSpaceModel, *arguments: Array) -> Array:
        assert system.integrator is not None
        if system.integrator.is_stable_at(_ANY_FACTOR).all():  # exact for linear equations
            return np.zeros(len(arguments[0]))
        half = system.with_integrator(system.integrator.refined())
        factors, of_halves = path_eigenvalues([system, half], *arguments)
        differences = np.abs(np.sort(factors, axis=-1) - np.sort(of_halves**2, axis=-1))
        return np.nan_to_num(differences, nan=0.0).max(axis=(1, 2))

    along = _along_paths(model, difference)
    return None if along is None else lambda x: along(x).max(axis=1)


def _along_paths(
    model: pm.Model, examine: Callable[..., NDArray[Any]]
) -> Callable[[Array], NDArray[Any]] | None:
    """What ``examine(system, theta, steps, inputs, t0)`` gives for every record, (m, records).

    Of systems whose steps have an error; those of `ExactLinear` would be thousands of exponentials.
    """
    nodes = [
        n
        for n in likelihood_nodes([log_density_graph(model)])
        if _has_error(n.op.system.integrator)
    ]
    if not nodes:
        return None
    # theta, steps, inputs and t0, but not data and seed.
    records = GraphsAtPoints(model, [node.inputs[i] for node in nodes for i in (0, 1, 3, 4)])

    def along(x: Array) -> NDArray[Any]:
        columns, found = records(x), []
        for i, node in enumerate(nodes):
            arguments = columns[4 * i : 4 * i + 4]
            if node.op.form == PANEL:
                arguments = _each_record(*arguments)
            found.append(examine(node.op.system, *arguments).reshape(len(x), -1))
        return np.concatenate(found, axis=1)

    return along


def _has_error(integrator: Any) -> bool:
    """Whether there is an integrator, and its steps would change with their length."""
    return integrator is not None and integrator.refined() is not integrator


def _each_record(theta: Array, rows: Array, inputs: Array, t0: Array) -> list[Array]:
    """The arguments of `path_eigenvalues` of all records of a panel at m points, m times G points.

    Each record has as many rows of inputs as a path reads, its last one repeated.
    """
    n_points, n_records, n_theta = theta.shape
    codes = rows[0, :, RECORD]
    starts = np.flatnonzero(np.concatenate([[True], codes[1:] != codes[:-1]]))
    lasts = rows[0, np.append(starts[1:], codes.size) - 1, STEP]
    steps = np.arange(min(int(lasts.max()), MAX_STEPS) + 1)
    if inputs.shape[1]:
        own = np.minimum(steps, np.maximum(lasts - 1, 0)[:, None])
        inputs = inputs[:, rows[0, starts, FIRST_INPUT][:, None] + own]
        inputs = inputs.reshape(n_points * n_records, steps.size, -1)
    else:
        inputs = np.repeat(inputs, n_records, axis=0)
    return [
        theta.reshape(-1, n_theta),
        np.tile(steps, (n_points * n_records, 1)),
        inputs,
        np.repeat(t0, n_records),
    ]


def path_eigenvalues(
    systems: Sequence[StateSpaceModel], theta: Array, steps: Array, inputs: Array, t0: Array
) -> list[NDArray[np.complex128]]:
    """Eigenvalues (m, K, n) of the Jacobians of each system's substep at K states of one path.

    The substep is that which the integrator names for this, if it names one. The path is that of
    the first system without noise, from the initial mean. The arguments are those of the likelihood
    at m points. Eigenvalues are NaN where the Jacobian is not finite.
    """
    system = systems[0]
    assert system.integrator is not None
    single = system.with_integrator(system.integrator.substep())
    length, substeps = single.dt, round(system.dt / single.dt)
    start, advance, *jacobians = _compile_path(single, list(map(_examined, systems)))
    if inputs.shape[1] == 0:  # a system without inputs
        inputs = np.zeros((len(theta), 1, system.n_input_columns))
    n_steps = min(int(steps.max(initial=0)) * substeps, MAX_STEPS)
    # The last row of a record at any times begins no step.
    n_rows = max(n_steps // substeps + (not system.is_at_any_times), 1)
    rows = with_resets(system, inputs[:, :n_rows], 0.0)
    inputs = divided(system, rows, substeps)
    x = start(theta)
    eigenvalues: list[list[NDArray[np.complex128]]] = [[] for _ in systems]
    with np.errstate(all="ignore"):
        for k in range(n_steps + 1):
            row, t = inputs[:, min(k, inputs.shape[1] - 1)], t0 + k * length
            if k % STEPS_PER_JACOBIAN == 0 or k == n_steps:
                of_step = without_events(system, row)
                for found, jacobian in zip(eigenvalues, jacobians, strict=True):
                    found.append(_eigenvalues(jacobian(theta, x, of_step, t)))
            x = advance(theta, x, row, t)
    return [np.stack(found, axis=1) for found in eigenvalues]


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


def _compile_path(system: StateSpaceModel, examined: Sequence[StateSpaceModel]) -> list[Callable]:
    """Initial mean, next state, and Jacobians of the examined steps, each for many points."""
    symbols = symbols_of(system)
    theta, now = symbols["theta"], [symbols[name] for name in ("theta", "x", "u", "t")]
    values = dict(zip(("theta", "x", "u", "t"), now, strict=True))
    start = call(system.equations.initial_mean, system, {"theta": theta})
    steps = [call(s.equations.transition, s, values) for s in (system, *examined)]
    graphs = [steps[0], *(jacobian_of(step, values["x"]) for step in steps[1:])]
    return [
        interpreted_at_points([theta], start),
        *(interpreted_at_points(now, graph) for graph in graphs),
    ]
