"""From the functions of a system to its frozen graphs, in three steps: read, size, trace.

`read` checks the functions and their signatures, `size` makes the symbols, whose lengths follow
from the initial mean and the noises, and `trace` calls the functions with these symbols and makes
immutable graphs of what they return.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_positive
from .drift import (
    DriftingParameter,
    MovingRow,
    bordered,
    held_for,
    moved,
    starts,
    values_now,
)
from .equations import (
    Equation,
    as_matrix,
    as_vector,
    read_covariance,
    read_equation,
    trace_covariance,
)
from .graph_digest import freeze
from .input_columns import InputRow, input_row, reset
from .integrators.protocol import Integrator
from .observation import (
    DensityObservation,
    GaussianObservation,
    TracedObservation,
    read_observation,
)
from .random_variables import Drawn, trace_distributions
from .signature import Signature, parameter_symbols, size_of
from .start import Start, check_start, read_initial_mean, trace_start

Values = Mapping[str, TensorVariable]

INPUT_ROW = 3  # of the inputs theta, x, q, u, t, e and d of a traced function


@dataclass(frozen=True)
class Functions:
    """The functions and numbers of a system, read and not called yet."""

    transition: "Integrator | FunctionTransition"
    observation: GaussianObservation | DensityObservation
    process_noise: Any
    process_dist: Equation | None
    initial_mean: Any
    initial_cov: Any
    initial_dist: Equation | None
    event: Equation | None

    @property
    def equations(self) -> list[Equation]:
        """The user's functions, in the order in which their parameters are listed."""
        others = (
            self.process_noise, self.process_dist, self.initial_mean, self.initial_cov,
            self.initial_dist, self.event,
        )  # fmt: skip
        found = [other for other in others if isinstance(other, Equation)]
        return [*self.transition.equations, *self.observation.equations, *found]

    @property
    def equations_of_steps(self) -> list[Equation]:
        """The user's functions that hold at every step, and not at the start alone."""
        others = [self.process_noise, self.process_dist, self.event]
        found = [other for other in others if isinstance(other, Equation)]
        return [*self.transition.equations, *self.observation.equations, *found]

    def at_length(self, length: TensorVariable) -> "Functions":
        """The same with steps of this length, a symbol."""
        return replace(self, transition=self.transition.at_length(length))  # type: ignore[union-attr]


@dataclass(frozen=True)
class Symbols:
    """The symbols that the functions are called with: all parameters in one vector, and by name.

    ``state``, ``noise`` and ``input_row`` are whole: with ``drifting`` parameters and all columns.
    ``values`` has the user's parts of them; its parameters are those of the step, and those of
    ``start_values`` the ones at the start. ``time`` is that of a step on a grid; ``values["t"]`` is
    the one that the functions see.
    """

    theta: TensorVariable
    state: TensorVariable
    noise: TensorVariable
    start_values: Values
    values: Values
    input_row: InputRow
    time: TensorVariable
    drawn: Drawn | None
    start: Start
    drifting: Sequence[DriftingParameter]

    dt: float

    @property
    def moving_row(self) -> MovingRow:
        """When parameters move."""
        length = self.input_row.length
        return MovingRow(self.dt if length is None else length, self.dt, self.input_row.moves)

    @property
    def n_written(self) -> int:
        """Number of states of the user's functions."""
        return self.values["x"].type.shape[0]

    @property
    def n(self) -> int:
        """Number of states."""
        return self.state.type.shape[0]

    @property
    def m(self) -> int:
        """Number of process noises."""
        return self.noise.type.shape[0]


@dataclass(frozen=True)
class Equations:
    """The traced functions of a system, frozen graphs of theta, x, q, u, t, e and d.

    ``process_noise`` is None where ``q`` holds standard normals: for most integrators and for
    ``process_dist``, whose distributions are part of the transition. If these are not normal,
    ``gaussian_transition`` is the transition with normal variables of their means and variances.
    ``initial_draw``, of theta and normals, is that of a start that is not Gaussian.

    ``finite_step`` has a further input ``v``, the values of the variables of ``process_dist`` that
    take finitely many: the next state given them, then their law, see `GivenValues`.
    ``finite_start``, of theta, normals and values, is the same of the start. ``censoring`` are the
    flags (p,) of a system with censored data. These follow from what the user wrote, as the others
    do, and are not compared.
    """

    transition: FrozenFunctionGraph
    gaussian_transition: FrozenFunctionGraph | None
    process_noise: FrozenFunctionGraph | None
    observation: FrozenFunctionGraph | None
    observation_noise: FrozenFunctionGraph | None
    observation_logp: FrozenFunctionGraph | None
    observation_draw: FrozenFunctionGraph | None
    initial_mean: FrozenFunctionGraph
    initial_cov: FrozenFunctionGraph
    initial_draw: FrozenFunctionGraph | None
    finite_step: FrozenFunctionGraph | None = field(default=None, compare=False)
    finite_start: FrozenFunctionGraph | None = field(default=None, compare=False)
    others_are_gaussian: bool = field(default=True, compare=False)
    censoring: FrozenFunctionGraph | None = field(default=None, compare=False)


def read(
    *,
    transition: Any,
    process_noise: Any,
    process_dist: Callable | None,
    dt: float | None,
    observation: Callable | None,
    observation_noise: Any,
    observation_dist: Callable | None,
    observation_logp: Callable | None,
    initial_mean: Any,
    initial_cov: Any,
    initial_dist: Callable | None,
    event: Callable | None,
    events: Sequence[str],
) -> Functions:
    """Check the functions of a system one by one; nothing is called.

    ``events`` are the names of the numbers of an event.
    """
    check_start(initial_mean, initial_cov, initial_dist)
    return Functions(
        _read_transition(transition, process_noise, process_dist, dt),
        read_observation(observation, observation_noise, observation_dist, observation_logp),
        read_covariance("process_noise", process_noise),
        None if process_dist is None else read_equation("process_dist", process_dist, "xut"),
        None if initial_mean is None else read_initial_mean(initial_mean),
        read_covariance("initial_cov", initial_cov),
        None if initial_dist is None else read_equation("initial_dist", initial_dist, ""),
        None if event is None else read_equation("event", event, ("x", "u", "t", *events)),
    )


def size(
    functions: Functions,
    signature: Signature,
    drifting: Sequence[DriftingParameter] = (),
    *,
    n_accumulators: int = 0,
    at_any_times: bool = False,
    events: Sequence[str] = (),
    n_censored: int = 0,
) -> Symbols:
    """Make the symbols, parameters first: the lengths of the others depend on them."""
    n_theta = sum(map(size_of, signature.shapes))
    theta = pt.tensor("theta", shape=(n_theta,), dtype="float64")
    values = parameter_symbols(theta, signature.parameters, signature.shapes)
    start = trace_start(functions.initial_mean, functions.initial_dist, values, theta)
    row = input_row(
        len(signature.inputs),
        at_any_times=at_any_times,
        n_accumulators=n_accumulators,
        held_for=held_for(drifting),
        n_of_step=(0 if functions.event is None else 1 + len(events)) + n_censored,
        n_censored=n_censored,
    )
    time = pt.tensor("t", shape=(), dtype="float64")
    state, x = _longer("x", start.mean.type.shape[0], len(drifting))
    values |= {"x": x, "u": row.of_user, "t": time if row.time is None else row.time}
    values |= {name: row.columns[i] for i, name in enumerate(events, 1)}
    now = values_now(drifting, values, state[x.type.shape[0] :])
    drawn = None
    if functions.process_dist is not None:
        drawn = trace_distributions(functions.process_dist, now, theta, "q")
        m = drawn.normals.type.shape[0]
    else:
        m = _noise_size(functions, now)
    noise, q = _longer("q", m, len(drifting))
    return Symbols(
        theta, state, noise, values, now | {"q": q}, row, time, drawn, start, drifting,
        float(functions.transition.dt),
    )  # fmt: skip


def _longer(name: str, size: int, n_more: int) -> tuple[TensorVariable, TensorVariable]:
    """A vector with ``n_more`` elements behind those of the user, and the user's part."""
    whole = pt.tensor(name, shape=(size + n_more,), dtype="float64")
    return whole, whole[:size] if n_more else whole


def trace(
    functions: Functions,
    symbols: Symbols,
    observables: Sequence[str] | None,
    accumulators: Sequence[int] = (),
) -> tuple[Equations, TracedObservation]:
    """Call the functions with the symbols, and freeze what they return.

    A step begins from the state in which the accumulators, given by their indices, are reset, and
    which an event has then changed.
    """
    values, theta, u = symbols.values, symbols.theta, symbols.input_row.whole
    functions = _of_length(functions, symbols)
    n_observables = None if observables is None else len(observables)
    flags = symbols.input_row.flags
    seen = functions.observation.trace(values, n_observables, flags)
    process_noise = _trace_process_noise(functions, symbols)
    for role, cov in (("observation_noise", seen.covariance), ("process_noise", process_noise)):
        _check_free_of_state(role, cov, symbols)
    start, initial_cov = _whole_start(functions, symbols)
    inputs = [theta, symbols.state, symbols.noise, u, symbols.time, seen.noise, seen.datum]

    def frozen(role: str, output: TensorVariable | None) -> FrozenFunctionGraph | None:
        return None if output is None else freeze(inputs, [output], role)

    begin = _after_event(functions, symbols, reset(symbols.state, u, accumulators))
    transition, gaussian_transition = (
        freeze(inputs, graph_replace([step], {symbols.state: begin}, strict=False), "transition")
        for step in _steps(functions, symbols)
    )
    density = "observation_logp" if seen.draw is None else "observation_dist"
    equations = Equations(
        transition=transition,
        gaussian_transition=None if gaussian_transition == transition else gaussian_transition,
        process_noise=frozen("process_noise", process_noise),
        observation=frozen("observation", seen.observation),
        observation_noise=frozen("observation_noise", seen.covariance),
        observation_logp=frozen(density, seen.logp),
        observation_draw=seen.freeze_draw(inputs),
        initial_mean=freeze(inputs, [start.mean], "initial_mean"),
        initial_cov=freeze(inputs, [initial_cov], "initial_cov"),
        initial_draw=start.freeze_draw(theta),
        finite_start=start.freeze_given_values(theta),
        others_are_gaussian=start.given is None or start.given.others_are_gaussian,
        censoring=frozen("censored", flags),
    )
    return _with_finite_step(equations, functions, symbols, inputs, begin), seen


def _after_event(functions: Functions, symbols: Symbols, state: TensorVariable) -> TensorVariable:
    """The state from which a step begins, with its drifting parameters, which no event changes."""
    if functions.event is None:
        return state
    n = symbols.n_written
    changed = as_vector("event", functions.event(symbols.values), n)
    (changed,) = graph_replace([changed], {symbols.state: state}, strict=False)
    is_event = pt.gt(symbols.input_row.columns[0], 0.5)
    return pt.set_subtensor(state[:n], pt.switch(is_event, changed, state[:n]))


def _with_finite_step(
    equations: Equations,
    functions: Functions,
    symbols: Symbols,
    inputs: Sequence[TensorVariable],
    begin: TensorVariable,
) -> Equations:
    """The equations with a step given the values of finite variables, if there are any."""
    drawn = symbols.drawn
    if drawn is None or drawn.given is None:
        return equations
    given, q = drawn.given, drawn.given.entries.copy(name="q")
    step = functions.transition.step({**symbols.values, "q": q})
    step = _with_moves(as_vector("transition", step, symbols.n_written), symbols)
    (both,) = graph_replace(
        [pt.concatenate([step, given.law])], {drawn.normals: symbols.values["q"]}, strict=False
    )
    both = graph_replace(both, {symbols.state: begin}, strict=False)
    graph = freeze([*inputs, given.values], [both], "process_dist")
    are_gaussian = equations.others_are_gaussian and given.others_are_gaussian
    return replace(equations, finite_step=graph, others_are_gaussian=are_gaussian)


def _of_length(functions: Functions, symbols: Symbols) -> Functions:
    """The functions with steps of the length that they need.

    The matrices of an exact step are computed once per evaluation; where one of its parameters
    drifts they are those of the step, as where its length is a column of inputs.
    """
    length, transition = symbols.input_row.length, functions.transition
    drifts = {one.parameter for one in symbols.drifting}
    own = {name for equation in transition.equations for name in equation.parameters}
    if length is None and hasattr(transition, "noise_cov") and drifts & own:
        length = pt.as_tensor(np.float64(transition.dt))
    return functions if length is None else functions.at_length(length)


def _check_free_of_state(role: str, cov: TensorVariable | None, symbols: Symbols) -> None:
    """Raise if a covariance depends on a drifting parameter."""
    if cov is None or symbols.state not in ancestors([cov]):
        return
    names = [one.name for one in symbols.drifting]
    of_noise, noise = ("transition", "q") if role == "process_noise" else ("observation", "e")
    raise ModelError(
        f"{role} must not depend on drifting parameters, {names}: give it the covariance of "
        f"standard noise, and scale {noise} in {of_noise}, as in [... + sd * {noise}[0]]"
    )


def _whole_start(functions: Functions, symbols: Symbols) -> tuple[Start, TensorVariable]:
    """The start, and its covariance, with drifting parameters at their values."""
    start, values, drifting = symbols.start, symbols.start_values, symbols.drifting
    cov = start.cov
    if functions.initial_dist is None:
        cov = trace_covariance("initial_cov", functions.initial_cov, symbols.n_written, values)
    if not drifting:
        return start, cov
    numbers = starts(drifting, values)
    mean = pt.concatenate([start.mean, numbers])
    draw = None if start.draw is None else pt.concatenate([start.draw, numbers])
    given = start.given
    if given is not None:
        given = replace(given, entries=pt.concatenate([given.entries, numbers]))
    return replace(start, mean=mean, draw=draw, given=given), bordered(cov, len(drifting), 0.0)


def _steps(functions: Functions, symbols: Symbols) -> tuple[TensorVariable, TensorVariable]:
    """The next state, and the same linear in normal variables."""
    values, drawn, n = symbols.values, symbols.drawn, symbols.n_written
    if drawn is None:
        noises = [values["q"]]
    else:  # named for messages about an index that is out of range
        noises = [vector.copy(name="q") for vector in (drawn.exact, drawn.surrogate)]
    steps = [functions.transition.step({**values, "q": q}) for q in noises]
    linear = getattr(functions.transition, "linear_in_noise", None)
    surrogate = steps[-1] if linear is None else linear().step(values)
    exact, gaussian = (as_vector("transition", step, n) for step in (steps[0], surrogate))
    if drawn is None:
        return _with_moves(exact, symbols), _with_moves(gaussian, symbols)
    both = [drawn.where_valid(exact), gaussian]
    exact, gaussian = graph_replace(both, {drawn.normals: values["q"]}, strict=False)
    return _with_moves(exact, symbols), _with_moves(gaussian, symbols)


def _with_moves(step: TensorVariable, symbols: Symbols) -> TensorVariable:
    """The next state with its drifting parameters."""
    drifting = symbols.drifting
    if not drifting:
        return step
    n, m = symbols.n_written, symbols.m - len(drifting)
    numbers, noises = symbols.state[n:], symbols.noise[m:]
    return pt.concatenate(
        [step, moved(drifting, symbols.start_values, numbers, noises, symbols.moving_row)]
    )


@dataclass(frozen=True)
class FunctionTransition:
    """A transition written as a function ``g(x, q, u, t, ...)``."""

    equation: Equation
    dt: float

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The function alone."""
        return (self.equation,)

    def noise_size(self, values: Values) -> int:
        """Number of process noises without a covariance of them: none."""
        if "q" in self.equation.symbols:
            raise ModelError(
                "process_noise must be the covariance of q, an argument of transition, or "
                "process_dist its distributions, got None"
            )
        return 0

    def step(self, values: Values) -> TensorVariable:
        """The next state."""
        return as_vector("transition", self.equation(values), values["x"].type.shape[0])


def _read_transition(
    transition: Any, process_noise: Any, process_dist: Any, dt: float | None
) -> Integrator | FunctionTransition:
    if process_noise is not None and process_dist is not None:
        raise ModelError(
            "give process_noise or process_dist, got both; Gaussian noise beside other noise is "
            "pm.Normal.dist(0, sd) in the list of process_dist"
        )
    if isinstance(transition, Integrator):
        if process_dist is not None:
            raise ModelError(
                "process_dist must be None beside an integrator, whose noise is its diffusion; "
                "write the step as a function, transition=lambda x, q: [x[0] + dt * drift + q[0]]"
            )
        if process_noise is not None:
            raise ModelError(
                "process_noise must be None beside an integrator, which has a diffusion, "
                f"got {process_noise!r}"
            )
        if dt is not None:
            raise ModelError(f"dt must be None beside an integrator, which has a dt, got dt={dt!r}")
        check_positive("dt", transition.dt)
        return transition
    if hasattr(transition, "step"):
        members = [name for name in vars(Integrator) if not name.startswith("_")]
        missing = [name for name in members if not hasattr(transition, name)]
        raise ModelError(
            f"transition must be a function or an integrator, got {type(transition).__name__}, "
            f"an integrator without {', '.join(missing)}"
        )
    equation = read_equation("transition", transition, "xqut")
    if process_noise is not None and "q" not in equation.symbols:
        raise ModelError(
            "process_noise must be None where transition does not have the argument q, "
            f"got {process_noise!r}"
        )
    if process_dist is not None and "q" not in equation.symbols:
        raise ModelError(
            "process_dist must be None where transition does not have the argument q, "
            f"got {process_dist!r}"
        )
    return FunctionTransition(equation, check_positive("dt", 1.0 if dt is None else dt))


def _trace_process_noise(functions: Functions, symbols: Symbols) -> TensorVariable | None:
    """The covariance of the noise; None where it is standard normals."""
    values, cov = symbols.values, None
    m = values["q"].type.shape[0]
    if functions.process_noise is not None:
        cov = trace_covariance("process_noise", functions.process_noise, m, values)
    elif (declared := getattr(functions.transition, "noise_cov", None)) is not None:
        cov = as_matrix("noise_cov", declared(values), m, m)
    if cov is None or not symbols.drifting:
        return cov
    return bordered(cov, len(symbols.drifting), 1.0)


def _noise_size(functions: Functions, values: Values) -> int:
    noise = functions.process_noise
    if noise is None:
        return functions.transition.noise_size(values)
    return trace_covariance("process_noise", noise, None, values).type.shape[0]
