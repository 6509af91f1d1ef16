"""From the functions of a system to its frozen graphs, in three steps: read, size, trace.

`read` checks the functions and their signatures, `size` makes the symbols, whose lengths follow
from the initial mean and the noises, and `trace` calls the functions with these symbols and makes
immutable graphs of what they return.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_positive
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

    @property
    def equations(self) -> list[Equation]:
        """The user's functions, in the order in which their parameters are listed."""
        others = (
            self.process_noise, self.process_dist, self.initial_mean, self.initial_cov,
            self.initial_dist,
        )  # fmt: skip
        found = [other for other in others if isinstance(other, Equation)]
        return [*self.transition.equations, *self.observation.equations, *found]

    def at_length(self, length: TensorVariable) -> "Functions":
        """The same with steps of this length, a symbol."""
        return replace(self, transition=self.transition.at_length(length))  # type: ignore[union-attr]


@dataclass(frozen=True)
class Symbols:
    """The symbols that the functions are called with: all parameters in one vector, and by name.

    ``input_row`` is a row of inputs with all columns; ``values["u"]`` are the user's. ``time`` is
    that of a step on a grid; ``values["t"]`` is the one that the functions see.
    """

    theta: TensorVariable
    values: Values
    input_row: InputRow
    time: TensorVariable
    drawn: Drawn | None
    start: Start

    @property
    def n(self) -> int:
        """Number of states."""
        return self.values["x"].type.shape[0]

    @property
    def m(self) -> int:
        """Number of process noises."""
        return self.values["q"].type.shape[0]


@dataclass(frozen=True)
class Equations:
    """The traced functions of a system, frozen graphs of theta, x, q, u, t, e and d.

    ``process_noise`` is None where ``q`` holds standard normals: for most integrators and for
    ``process_dist``, whose distributions are part of the transition. If these are not normal,
    ``gaussian_transition`` is the transition with normal variables of their means and variances.
    ``initial_draw``, of theta and normals, is that of a start that is not Gaussian.

    ``finite_step`` has a further input ``v``, the values of the variables of ``process_dist`` that
    take finitely many: the next state given them, then their law, see `GivenValues`.
    ``finite_start``, of theta, normals and values, is the same of the start. Both follow from what
    the user wrote, as the others do, and are not compared.
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
) -> Functions:
    """Check the functions of a system one by one; nothing is called."""
    check_start(initial_mean, initial_cov, initial_dist)
    return Functions(
        _read_transition(transition, process_noise, process_dist, dt),
        read_observation(observation, observation_noise, observation_dist, observation_logp),
        read_covariance("process_noise", process_noise),
        None if process_dist is None else read_equation("process_dist", process_dist, "xut"),
        None if initial_mean is None else read_initial_mean(initial_mean),
        read_covariance("initial_cov", initial_cov),
        None if initial_dist is None else read_equation("initial_dist", initial_dist, ""),
    )


def size(
    functions: Functions,
    signature: Signature,
    *,
    has_accumulators: bool = False,
    at_any_times: bool = False,
) -> Symbols:
    """Make the symbols, parameters first: the lengths of the others depend on them."""
    n_theta = sum(map(size_of, signature.shapes))
    theta = pt.tensor("theta", shape=(n_theta,), dtype="float64")
    values = parameter_symbols(theta, signature.parameters, signature.shapes)
    start = trace_start(functions.initial_mean, functions.initial_dist, values, theta)
    n = start.mean.type.shape[0]
    row = input_row(
        len(signature.inputs), at_any_times=at_any_times, has_accumulators=has_accumulators
    )
    time = pt.tensor("t", shape=(), dtype="float64")
    values |= {
        "x": pt.tensor("x", shape=(n,), dtype="float64"),
        "u": row.of_user,
        "t": time if row.time is None else row.time,
    }
    drawn = None
    if functions.process_dist is not None:
        drawn = trace_distributions(functions.process_dist, values, theta, "q")
        noise = drawn.normals
    else:
        noise = pt.tensor("q", shape=(_noise_size(functions, values),), dtype="float64")
    return Symbols(theta, values | {"q": noise}, row, time, drawn, start)


def trace(
    functions: Functions,
    symbols: Symbols,
    observables: Sequence[str] | None,
    accumulators: Sequence[int] = (),
) -> tuple[Equations, TracedObservation]:
    """Call the functions with the symbols, and freeze what they return.

    A step begins from the state in which the accumulators, given by their indices, are reset.
    """
    values, n, m = symbols.values, symbols.n, symbols.m
    if symbols.input_row.length is not None:
        functions = functions.at_length(symbols.input_row.length)
    n_observables = None if observables is None else len(observables)
    seen = functions.observation.trace(values, n_observables)
    process_noise = _trace_process_noise(functions, values, m)
    start, theta = symbols.start, symbols.theta
    initial_cov = start.cov
    if functions.initial_dist is None:
        initial_cov = trace_covariance("initial_cov", functions.initial_cov, n, values)
    x, q, u = values["x"], values["q"], symbols.input_row.whole
    inputs = [theta, x, q, u, symbols.time, seen.noise, seen.datum]

    def frozen(role: str, output: TensorVariable | None) -> FrozenFunctionGraph | None:
        return None if output is None else freeze(inputs, [output], role)

    begin = reset(x, u, accumulators)
    transition, gaussian_transition = (
        freeze(inputs, graph_replace([step], {x: begin}, strict=False), "transition")
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
    )
    return _with_finite_step(equations, functions, symbols, inputs, begin), seen


def _with_finite_step(
    equations: Equations,
    functions: Functions,
    symbols: Symbols,
    inputs: Sequence[TensorVariable],
    begin: TensorVariable,
) -> Equations:
    """The equations with a step given the values of finite variables, if there are any."""
    given = None if symbols.drawn is None else symbols.drawn.given
    if given is None:
        return equations
    q = given.entries.copy(name="q")
    step = as_vector("transition", functions.transition.step({**symbols.values, "q": q}), symbols.n)
    both = graph_replace(
        pt.concatenate([step, given.law]), {symbols.values["x"]: begin}, strict=False
    )
    graph = freeze([*inputs, given.values], [both], "process_dist")
    return replace(equations, finite_step=graph, others_are_gaussian=given.others_are_gaussian)


def _steps(functions: Functions, symbols: Symbols) -> tuple[TensorVariable, TensorVariable]:
    """The next state, and the same linear in normal variables."""
    values, drawn = symbols.values, symbols.drawn
    if drawn is None:
        noises = [values["q"]]
    else:  # named for messages about an index that is out of range
        noises = [vector.copy(name="q") for vector in (drawn.exact, drawn.surrogate)]
    steps = [functions.transition.step({**values, "q": q}) for q in noises]
    linear = getattr(functions.transition, "linear_in_noise", None)
    surrogate = steps[-1] if linear is None else linear().step(values)
    exact, gaussian = (as_vector("transition", step, symbols.n) for step in (steps[0], surrogate))
    return exact if drawn is None else drawn.where_valid(exact), gaussian


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


def _trace_process_noise(functions: Functions, values: Values, m: int) -> TensorVariable | None:
    """The covariance of q; None where q are standard normals."""
    if functions.process_noise is not None:
        return trace_covariance("process_noise", functions.process_noise, m, values)
    declared = getattr(functions.transition, "noise_cov", None)
    return None if declared is None else as_matrix("noise_cov", declared(values), m, m)


def _noise_size(functions: Functions, values: Values) -> int:
    noise = functions.process_noise
    if noise is None:
        return functions.transition.noise_size(values)
    return trace_covariance("process_noise", noise, None, values).type.shape[0]
