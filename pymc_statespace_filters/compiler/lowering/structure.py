"""Structure found from the Jacobians of a system: linearity, and noises that can be merged."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytensor
import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.compile.mode import get_mode
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...system.equations import folded_constants
from ...system.model import StateSpaceModel
from ..codegen.emitter import depends_on
from ..codegen.expressions import Expression, in_order, is_constant
from ..codegen.function_types import Graph
from ..codegen.functions import unrolled
from ..codegen.scalarize import NotUnrollableError
from .jumps import STEPPED
from .symbols import (
    SYMBOLS,
    call,
    jacobian_of,
    observation_moments,
    process_noise_cov,
    symbols_of,
    transition_moments,
)

_N_TRIALS = 5
_LARGE_START = 1e10  # times the variance of a sensor's noise
KINKED = (
    ps.Switch, ps.Abs, ps.ScalarMaximum, ps.ScalarMinimum, ps.Clip, ps.Sign, ps.Floor, ps.Ceil,
    ps.Mod, ps.IntDiv, ps.Cast,
)  # fmt: skip


def merged_noise(system: StateSpaceModel) -> FrozenFunctionGraph | None:
    """B Q B^T, if g(x, q) = g(x, 0) + B q with more noises than states and B the same everywhere.

    The sum of independent noises on one state, ``[[0.6, sigma_m]]``, has the distribution of a
    single noise, and drawing normals is most of the cost of an ensemble.
    """
    if system.m <= system.n or system.keeps_noises or not system.has_gaussian_steps:
        return None
    symbols = symbols_of(system)
    gain = jacobian_of(call(system.equations.transition, system, symbols), symbols["q"])
    if not is_free_of(("x", "q", "u", "t"), gain, symbols):
        return None
    cov = process_noise_cov(system, symbols, gain)
    return FrozenFunctionGraph.from_io([symbols[s] for s in SYMBOLS], [cov])


def is_deterministic(system: StateSpaceModel) -> bool:
    """Whether the state is a function of the parameters: known at step 0, and without noise.

    False where that cannot be decided.
    """
    symbols, noise_cov = symbols_of(system), system.equations.process_noise
    if not _is_zero(call(system.equations.initial_cov, system, symbols), symbols):
        return False
    if system.m == 0 or is_free_of(
        ("q",), call(system.equations.transition, system, symbols), symbols
    ):
        return True
    return noise_cov is not None and _is_zero(call(noise_cov, system, symbols), symbols)


def undriven_states(system: StateSpaceModel) -> list[int]:
    """The states that depend on an uncertain start for good, and that no noise ever reaches.

    A position is reached by a noise of its velocity. Empty where that cannot be decided.
    """
    symbols = symbols_of(system)
    step = _sources(call(system.equations.transition, system, symbols), symbols)
    start = sources_of_start(system, symbols)
    if step is None or start is None:
        return []
    still = still_noises(system, symbols)
    driven = {i for i in range(system.n) if any(q not in still for q in _of("q", step[i]))}
    uncertain = {i for i in range(system.n) if start[i]}
    driven, uncertain = (_reached(step, states) for states in (driven, uncertain))
    return [i for i in range(system.n) if i not in driven and _of("x", step[i]) & uncertain]


def _sources(
    vector: TensorVariable, symbols: Mapping[str, TensorVariable]
) -> list[set[str]] | None:
    """The names of the inputs on which each element depends; None where that is not known."""
    try:
        (values,) = unrolled(Graph(symbols, [vector]))
    except NotUnrollableError:
        return None
    return [{str(e.args[0]) for e in in_order([value], {}) if e.op is None} for value in values]


def sources_of_start(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> list[Any] | None:
    """For each state something that is true if its start is uncertain."""
    draw = system.equations.initial_draw
    if draw is not None:
        z = draw.inputs[1].type("z")
        found = _sources(draw.bind([symbols["theta"], z])[0], {**symbols, "z": z})
        return None if found is None else [_of("z", names) for names in found]
    variances = zeros(pt.diagonal(call(system.equations.initial_cov, system, symbols)), symbols)
    return [not is_zero for is_zero in variances] if len(variances) == system.n else None


def still_noises(system: StateSpaceModel, symbols: Mapping[str, TensorVariable]) -> set[int]:
    """The noises whose variance is zero."""
    if system.equations.process_noise is None:
        return set()
    variances = pt.diagonal(call(system.equations.process_noise, system, symbols))
    return {i for i, is_zero in enumerate(zeros(variances, symbols)) if is_zero}


def _of(vector: str, names: set[str]) -> set[int]:
    """The indices of the elements of a vector among names such as "x.0"."""
    return {int(name.split(".")[1]) for name in names if name.startswith(f"{vector}.")}


def _reached(step: Sequence[set[str]], first: set[int]) -> set[int]:
    """The states that depend on the first ones after some steps, and these."""
    found = set(first)
    for _ in step:
        found |= {i for i, names in enumerate(step) if _of("x", names) & found}
    return found


def is_linear(system: StateSpaceModel) -> bool:
    """Whether state and noise, which is Gaussian, enter transition and observation linearly."""
    return (
        system.gaussian is system
        and not system.is_censored
        and has_linear_observation(system)
        and has_linear_transition(system)
    )


def has_linear_transition(system: StateSpaceModel) -> bool:
    """Whether state and noise enter the transition linearly; False where that is undecided."""
    return _is_linear(system, system.equations.transition, "xq")


def has_linear_observation(system: StateSpaceModel) -> bool:
    """Whether an observation with noise is linear in state and noise; False where undecided."""
    observation = system.equations.observation
    return observation is not None and _is_linear(system, observation, "xe")


def _is_linear(system: StateSpaceModel, graph: FrozenFunctionGraph, names: str) -> bool:
    symbols = symbols_of(system)
    value = call(graph, system, symbols)
    if not all(is_free_of(names, jacobian_of(value, symbols[name]), symbols) for name in names):
        return False
    # The Jacobian of a step, as of pt.sign, is zero on both of its sides.
    found = _dependent(names, value, symbols)
    return found is not None and not any(isinstance(e.op, (*STEPPED, ps.Cast)) for e in found)


def has_additive_process_noise(system: StateSpaceModel) -> bool:
    """Whether g(x, q) = g(x, 0) + G(x) q; False where that cannot be decided.

    False too where ``process_dist`` draws what is not normal.
    """
    if not system.has_gaussian_steps:
        return False
    symbols = symbols_of(system)
    transition = call(system.equations.transition, system, symbols)
    return is_free_of(("q",), jacobian_of(transition, symbols["q"]), symbols)


def has_smooth_transition(system: StateSpaceModel) -> bool:
    """Whether no part of the transition has a kink or a jump; False where undecided."""
    if not system.has_gaussian_steps:
        return False
    symbols = symbols_of(system)
    return _is_smooth(call(system.equations.transition, system, symbols), symbols)


def has_smooth_sensor(system: StateSpaceModel) -> bool:
    """Whether an observation with noise has no kink or jump as a function of the state.

    False where undecided. Distributions of observations count as smooth.
    """
    if system.equations.observation is None:
        return True
    symbols = symbols_of(system)
    return _is_smooth(call(system.equations.observation, system, symbols), symbols)


def is_smooth(system: StateSpaceModel) -> bool:
    """Whether no equation of a step or an observation has a kink or jump; False where undecided.

    As a function of states and parameters. Distributions of observations count as smooth.
    """
    if not system.has_gaussian_steps:
        return False
    symbols = symbols_of(system)
    equations = [system.equations.transition, system.equations.observation]
    vectors = [call(graph, system, symbols) for graph in equations if graph is not None]
    return all(is_smooth_vector(vector, symbols) for vector in vectors)


def is_smooth_vector(vector: TensorVariable, symbols: Mapping[str, TensorVariable]) -> bool:
    """Whether it has no kink or jump in states or parameters; False where undecided."""
    sizes = {name: symbols[name].type.shape[0] or 0 for name in ("x", "theta")}
    inputs = [f"{name}.{i}" for name, size in sizes.items() for i in range(size)]
    return _is_smooth(vector, symbols, inputs)


def _is_smooth(
    vector: TensorVariable, symbols: Mapping[str, TensorVariable], inputs: Sequence[str] = ("x.0",)
) -> bool:
    try:
        (values,) = unrolled(Graph(symbols, [vector]))
    except NotUnrollableError:
        return False
    dependent = depends_on(values, frozenset(inputs))
    return not any(isinstance(e.op, KINKED) and not _is_fixed(e, dependent) for e in dependent)


def _is_fixed(expression: Expression, dependent: set[Expression]) -> bool:
    """Whether it is a switch that does not move, as that between an event and none."""
    return isinstance(expression.op, ps.Switch) and expression.args[0] not in dependent


def step_moments(system: StateSpaceModel, symbols: Mapping[str, TensorVariable]) -> TensorVariable:
    """(g(x, 0), G Q G^T) of a system of one state with additive noise."""
    mean, cov = transition_moments(system, symbols)
    return pt.specify_shape(pt.concatenate([mean, cov.ravel()]), (2,))


def has_exact_sensor(system: StateSpaceModel) -> bool:
    """Whether a sensor is known to have no noise: its density given the state does not exist."""
    if system.equations.observation_logp is not None:
        return False
    symbols = symbols_of(system)
    _, cov = observation_moments(system, symbols)
    if not isinstance(cov, Constant):
        return any(zeros(pt.diagonal(cov), symbols))
    eigenvalues = np.linalg.eigvalsh(cov.data)
    return bool(eigenvalues.min() <= 1e-12 * eigenvalues.max())


def has_independent_sensors(system: StateSpaceModel) -> bool:
    """Whether the observables are independent given the state; False where undecided."""
    if system.equations.observation_logp is not None:
        return system.equations.observation_draw is not None
    symbols, others = symbols_of(system), np.nonzero(~np.eye(system.p, dtype=bool))
    _, cov = observation_moments(system, symbols)
    return system.p == 1 or all(zeros(cov[others], symbols))


def start_over_noise(system: StateSpaceModel) -> float:
    """How many times its noise the variance of an observation of the start is; 1 if unknown.

    Where two states or more start with large variances, and these are numbers; by the slope of the
    sensor at the initial mean and at parameters of one.
    """
    if system.n < 2 or not (system.gaussian_observation and system.has_gaussian_start):
        return 1.0
    symbols = symbols_of(system)
    start = call(system.equations.initial_cov, system, symbols)
    seen, noise = observation_moments(system, symbols)
    if not (isinstance(start, Constant) and isinstance(noise, Constant)):
        return 1.0
    variances, of_noise = np.sort(start.data.diagonal()), noise.data.diagonal()
    if not 0.0 < of_noise.min() * _LARGE_START < variances[-2]:
        return 1.0
    x = call(system.equations.initial_mean, system, symbols)
    (gain,) = graph_replace([jacobian_of(seen, symbols["x"])], {symbols["x"]: x}, strict=False)
    inputs = [symbols[name] for name in ("theta", "u", "t")]
    slope = pytensor.function(inputs, gain, mode="FAST_COMPILE", on_unused_input="ignore")(
        *(np.ones(value.type.shape) for value in inputs)
    )
    ratios = np.einsum("ij,jk,ik->i", slope, start.data, slope) / of_noise
    return float(np.nanmax(ratios, initial=1.0))


def process_noise_reaches_every_state(system: StateSpaceModel) -> bool:
    """Whether the noise of one step has a covariance of full rank at some point.

    Decided by trial at a few random points, because parameters may have any range; at exceptional
    points, such as a noise of zero, the rank may be lower.
    """
    if system.m < system.n:
        return False
    symbols = symbols_of(system)
    gain = jacobian_of(call(system.equations.transition, system, symbols), symbols["q"])
    cov = process_noise_cov(system, symbols, gain)
    inputs = [symbols[name] for name in ("theta", "x", "q", "u", "t")]
    # Canonical form makes one sum of the series of a step, of more terms than Python's can have.
    mode = get_mode("FAST_COMPILE").excluding("canonicalize")
    noise_cov = pytensor.function(inputs, cov, mode=mode, on_unused_input="ignore")
    rng = np.random.default_rng(0)
    for _ in range(_N_TRIALS):
        point = [np.abs(rng.normal(size=value.type.shape)) for value in inputs]
        found = noise_cov(*point)
        if np.isfinite(found).all() and (found.diagonal() > 0).all():
            sd = np.sqrt(found.diagonal())
            if np.linalg.matrix_rank(found / np.outer(sd, sd), tol=1e-10) == system.n:
                return True
    return False


def _is_zero(matrix: TensorVariable, symbols: Mapping[str, TensorVariable]) -> bool:
    """Whether every element is zero whatever the symbols; False where that cannot be decided."""
    return all(zeros(matrix.ravel(), symbols))


def zeros(vector: TensorVariable, symbols: Mapping[str, TensorVariable]) -> list[bool]:
    """Which elements are zero whatever the symbols; none where that cannot be decided."""
    try:
        (values,) = unrolled(Graph(symbols, [vector]))
    except NotUnrollableError:
        values = None
    if values is None or not all(map(is_constant, values)):  # folding takes twenty times as long
        (folded,) = folded_constants([vector])
        if not isinstance(folded, Variable):
            return [not value for value in np.asarray(folded)]
    return [False] if values is None else [bool(is_constant(v) and v == 0) for v in values]


def is_free_of(
    names: Sequence[str], matrix: TensorVariable, symbols: Mapping[str, TensorVariable]
) -> bool:
    """Whether no element depends on the named symbols; False where that cannot be decided."""
    found = _dependent(names, matrix, symbols)
    return found is not None and not found


def _dependent(
    names: Sequence[str], matrix: TensorVariable, symbols: Mapping[str, TensorVariable]
) -> set[Expression] | None:
    """The expressions under the elements that depend on the named symbols; None if undecided."""
    try:
        (values,) = unrolled(Graph(symbols, [matrix.ravel()]))
    except NotUnrollableError:
        return None
    sizes = {name: int(np.prod(symbols[name].type.shape, dtype=int)) for name in names}
    inputs = {f"{name}.{i}" for name, size in sizes.items() for i in range(size)}
    return depends_on(values, frozenset(inputs))


def parameters_after_start(system: StateSpaceModel) -> list[bool]:
    """Which elements of theta the equations of a step or an observation use; all if undecided."""
    system = system.gaussian
    symbols = symbols_of(system)
    moments = [*transition_moments(system, symbols)]
    if system.equations.observation is not None:
        moments += observation_moments(system, symbols)
    try:
        (values,) = unrolled(Graph(symbols, [pt.concatenate([m.ravel() for m in moments])]))
    except NotUnrollableError:
        return [True] * system.n_theta
    return [bool(depends_on(values, frozenset({f"theta.{i}"}))) for i in range(system.n_theta)]
