"""Whether an equation jumps as the state or a parameter moves: decided on lines.

A jump can only be where an operation of `STEPPED`, such as the comparison of a switch, changes its
value. Such places are searched on lines, at random parameters, and the equation is evaluated on
both sides: at a kink, as of ``pt.switch(x > 0, x, 0)``, it leaves no gap. A gap counts beside the
noise: where a force jumps, the state of a short step jumps by little, and is as good as continuous.

A parameter that is compared with nothing but times, inputs and parameters, as in
``pt.switch(t < tau, a, b)``, makes every likelihood a staircase: between two steps of the time it
does not change. There any gap counts. The threshold of a state is another matter, because its noise
smooths the steps.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pytensor.scalar as ps
import pytensor.tensor as pt

from ...system.model import StateSpaceModel
from ..codegen.emitter import depends_on
from ..codegen.expressions import Expression, Value
from ..codegen.function_types import Graph
from ..codegen.functions import unrolled
from ..codegen.scalarize import NotUnrollableError
from .symbols import observation_moments, symbols_of, transition_moments

STEPPED = (
    ps.Sign, ps.Floor, ps.Ceil, ps.Trunc, ps.RoundHalfToEven, ps.RoundHalfAwayFromZero, ps.Mod,
    ps.IntDiv, ps.LT, ps.GT, ps.LE, ps.GE, ps.EQ, ps.NEQ,
)  # fmt: skip
_ROUNDED = STEPPED[:8]  # which have many steps of one argument
_MOST_OF_A_CONDITION = 20  # operations; a longer one guards an algorithm, as a matrix's root
_MOST_EVALUATIONS = 40_000  # of scalar operations, on all lines together
_N_LINES = 6
_MOST_PLACES = 12  # on a line, those nearest to its middle
_N_HALVINGS = 60
_ROUNDING = 1e-6  # of a gap beside 1 and the value itself; rounding leaves far less
_OVERFLOWING = 1e100  # where a series, as of a matrix exponential, has left its domain
_JUMP = 0.3  # standard deviations of the noise: the least gap that counts

type Evaluate = Callable[[float], tuple[np.ndarray, tuple]]


def jumping_equations(system: StateSpaceModel) -> tuple[str, ...]:
    """Those of "transition" and "observation" that jump in the state; none where undecided.

    Carried states are left out: they are a memory that jumps, and no filter linearises them. Noise
    of any distribution counts by its mean and variance, as in the filters that linearise.
    """
    system = system.gaussian
    symbols = symbols_of(system)
    free = [i for i, name in enumerate(system.states) if name not in system.carried]
    states = frozenset(f"x.{i}" for i in free)
    moments = {"transition": transition_moments}
    if system.equations.observation is not None:
        moments["observation"] = observation_moments
    found = []
    for name, moments_of in moments.items():
        mean, cov = moments_of(system, symbols)
        rows = free if name == "transition" else range(system.p)
        if not rows:
            continue
        variances = pt.diagonal(cov)
        output = pt.stack([moment[i] for moment in (mean, variances) for i in rows])
        try:
            (elements,) = unrolled(Graph(symbols, [output]))
        except NotUnrollableError:
            continue
        if _jumps(elements, states, len(rows)):
            found.append(name)
    return tuple(found)


def jumping_parameters(system: StateSpaceModel) -> tuple[str, ...]:
    """Drifting parameters at whose threshold an equation jumps; none where that is undecided.

    Any gap counts: no linearisation sees that the parameter moves it.
    """
    if not system.drifting:
        return ()
    elements = _moments(system.gaussian)
    stepped = {e for e in _under(elements) if isinstance(e.op, STEPPED)}
    first = system.n - len(system.drifting)
    names = [f"x.{first + i}" for i in range(len(system.drifting))]
    return tuple(
        one.name
        for one, name in zip(system.drifting, names, strict=True)
        if _jumps_in(name, elements, stepped & depends_on(elements, frozenset({name})))
    )


def _moments(system: StateSpaceModel) -> Sequence[Value]:
    """Mean and covariance of a step and an observation, in scalars; none where undecided."""
    symbols = symbols_of(system)
    moments = [*transition_moments(system, symbols)]
    if system.equations.observation is not None:
        moments += observation_moments(system, symbols)
    try:
        (elements,) = unrolled(Graph(symbols, [pt.concatenate([m.ravel() for m in moments])]))
    except NotUnrollableError:
        return ()
    return elements


def stepped_parameters(system: StateSpaceModel) -> tuple[str, ...]:
    """Parameters of which every likelihood is a staircase; none where that is undecided."""
    elements = _moments(system.gaussian)
    everything = _under(elements)
    inputs = frozenset(e.args[0] for e in everything if e.op is None)
    moving = frozenset(name for name in inputs if name.split(".")[0] in ("x", "q", "e"))
    theta = frozenset(name for name in inputs if name.startswith("theta."))
    timed = depends_on(elements, inputs - moving - theta)
    stepped = {
        e
        for e in everything - depends_on(elements, moving)
        if isinstance(e.op, _ROUNDED) or (isinstance(e.op, STEPPED) and e in timed)
        if len(_under([e])) <= _MOST_OF_A_CONDITION
    }
    scalars = np.repeat(system.parameters, [math.prod(s) for s in system.parameter_shapes])
    found = [
        name
        for i, name in enumerate(scalars)
        if _jumps_in(
            f"theta.{i}", elements, stepped & depends_on(elements, frozenset({f"theta.{i}"}))
        )
    ]
    return tuple(dict.fromkeys(map(str, found)))


def _jumps_in(name: str, elements: Sequence[Value], stepped: set[Expression]) -> bool:
    """Whether elements jump as one input moves, on some line."""
    if not stepped:
        return False
    order = sorted(_under(elements), key=lambda e: e.number)
    ordered = [e for e in order if e in stepped]
    rng = np.random.default_rng(0)
    with_noise = [*elements, *np.ones(len(elements))]  # a gap counts as it is
    lines = [_on_line(order, with_noise, ordered, frozenset({name}), rng) for _ in range(_N_LINES)]
    distances = _distances(len(order))
    return any(_largest_gap(line, distances, len(elements)) > 0.0 for line in lines)


def _distances(n_operations: int) -> np.ndarray:
    """Points of a line, of so many operations each, close together near its middle."""
    n_points = int(np.clip(_MOST_EVALUATIONS / (_N_LINES * n_operations), 16, 200)) // 2
    far = np.geomspace(1e-3, 1e8, n_points)  # thresholds have the scale of the state
    return np.concatenate([-far[::-1], [0.0], far])


def _jumps(elements: Sequence[Value], states: frozenset[str], n: int) -> bool:
    """Whether the first n elements jump by more than the noise, whose variances are the others.

    The median of the lines decides, because parameters and their ratios may have any value.
    """
    of_mean = depends_on(elements[:n], states)
    if not any(isinstance(e.op, STEPPED) for e in of_mean):
        return False
    everything = of_mean | _under(elements)
    # Numbers follow the order in which expressions were made: arguments come first.
    order = sorted(everything, key=lambda e: e.number)
    stepped = [e for e in order if e in of_mean and isinstance(e.op, STEPPED)]
    distances = _distances(len(order))
    rng = np.random.default_rng(0)
    lines = [_on_line(order, elements, stepped, states, rng) for _ in range(_N_LINES)]
    gaps = [gap for line in lines if (gap := _largest_gap(line, distances, n)) > 0.0]
    return bool(gaps) and float(np.median(gaps)) > _JUMP


def _under(elements: Sequence[Value]) -> set[Expression]:
    """All expressions under ``elements``."""
    found: set[Expression] = set()
    stack = [e for e in elements if isinstance(e, Expression)]
    while stack:
        expression = stack.pop()
        if expression not in found:
            found.add(expression)
            arguments = () if expression.op is None else expression.args
            stack += [a for a in arguments if isinstance(a, Expression)]
    return found


def _on_line(
    order: Sequence[Expression],
    elements: Sequence[Value],
    stepped: Sequence[Expression],
    states: frozenset[str],
    rng: np.random.Generator,
) -> Evaluate:
    """The elements, and the values of the stepped operations, along a random line of states."""
    inputs = sorted(e.args[0] for e in order if e.op is None)
    point = {name: abs(rng.normal()) for name in inputs}
    direction = {name: rng.normal() for name in inputs if name in states}

    def evaluate(distance: float) -> tuple[np.ndarray, tuple]:
        values: dict[Value, float] = {}
        for e in order:
            if e.op is None:
                name = e.args[0]
                values[e] = np.float64(point[name] + distance * direction.get(name, 0.0))
            else:
                values[e] = e.op.impl(*(values.get(a, a) for a in e.args))
        steps = tuple(_step_of(e, values) for e in stepped)
        return np.array([values.get(e, e) for e in elements], dtype=float), steps

    return evaluate


def _step_of(expression: Expression, values: Mapping[Value, float]) -> float:
    """What is constant between the places where an operation may jump."""
    if isinstance(expression.op, ps.Mod):
        dividend, divisor = (values.get(a, a) for a in expression.args)
        return np.floor(dividend / divisor)
    return values[expression]


def _largest_gap(evaluate: Evaluate, distances: np.ndarray, n: int) -> float:
    """The largest gap on a line, in standard deviations of the noise; 0 without one."""
    with np.errstate(all="ignore"):
        try:
            points = [(s, *evaluate(s)) for s in distances]
            places = [(a, b) for a, b in pairwise(points) if a[2] != b[2]]
            places.sort(key=lambda place: abs(place[0][0]))
            return max((_gap_between(evaluate, *p, n) for p in places[:_MOST_PLACES]), default=0.0)
        except (ArithmeticError, ValueError):  # of a Python function far outside its domain
            return 0.0


def _gap_between(evaluate: Evaluate, left: tuple, right: tuple, n: int) -> float:
    """The gap where the steps change first between two points."""
    for _ in range(_N_HALVINGS):
        middle = 0.5 * (left[0] + right[0])
        if middle in (left[0], right[0]):
            break
        found = (middle, *evaluate(middle))
        left, right = (found, right) if found[2] == left[2] else (left, found)
    # A step further: the sign is 0 at the threshold itself.
    beyond = evaluate(right[0] + 2.0 * (right[0] - left[0]))
    below, above = left[1][:n], beyond[0][:n]
    gap = np.abs(above - below)
    is_gap = gap > _ROUNDING * (1.0 + np.minimum(np.abs(below), np.abs(above)))
    counted = is_gap & (gap < _OVERFLOWING)
    ratios = gap[counted] / np.sqrt(left[1][n:])[counted]
    return float(np.nanmax(ratios, initial=0.0))
