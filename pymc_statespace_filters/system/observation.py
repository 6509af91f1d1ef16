"""The observation of a state: a function with noise, PyMC distributions, or a log-density."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import graph_inputs, io_toposort
from pytensor.raise_op import CheckAndRaise
from pytensor.scalar.math import BetaInc, GammaInc, GammaIncC, Log1mexp
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.random.type import RandomType
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .equations import (
    RESERVED,
    Equation,
    as_symbol,
    as_vector,
    read_covariance,
    read_equation,
    trace_covariance,
)
from .graph_digest import freeze

Values = Mapping[str, TensorVariable]

# At which log-densities and their derivatives are finite, or known to be outside of the support.
_ANY_VALUE = 0.5


@dataclass(frozen=True)
class TracedObservation:
    """A traced observation: symbols of its noise and of an observation, and expressions of them."""

    noise: TensorVariable
    datum: TensorVariable
    observation: TensorVariable | None = None
    covariance: TensorVariable | None = None
    logp: TensorVariable | None = None
    draw: TensorVariable | None = None
    additive: bool = False

    @property
    def gaussian(self) -> bool:
        """Whether the density is that of a function with Gaussian noise, as Kalman updates need."""
        return self.logp is None

    def freeze_draw(self, symbols: Sequence[Variable]) -> FrozenFunctionGraph | None:
        """The graph that simulates an observation, with its random generators as more inputs."""
        if self.draw is None:
            return None
        generators = [
            v
            for v in graph_inputs([self.draw])
            if isinstance(v, SharedVariable) and isinstance(v.type, RandomType)
        ]
        return freeze([*symbols, *generators], [self.draw])


def read_observation(
    observation: Callable | None,
    observation_noise: Any,
    observation_dist: Callable | None,
    observation_logp: Callable | None,
) -> "GaussianObservation | DensityObservation":
    """Read the observation in one of its three forms; each gives exactly one density."""
    if observation_dist is not None and (observation is not None or observation_logp is not None):
        raise ModelError(
            "observation_dist must be given without observation and observation_logp, got both"
        )
    if observation_dist is None and observation_logp is None:
        if observation is None:
            raise ModelError("give one of observation, observation_dist and observation_logp")
        return GaussianObservation(observation, observation_noise)
    return DensityObservation(observation, observation_noise, observation_dist, observation_logp)


class GaussianObservation:
    """An observation function with Gaussian noise, additive or inside the function."""

    def __init__(self, observation: Callable, covariance: Any) -> None:
        if covariance is None:
            raise ModelError(
                "observation_noise must be the covariance of the observation, got None"
            )
        self.observation = _of_state(read_equation("observation", observation, "xeut"))
        self.covariance = read_covariance("observation_noise", covariance, "ut")

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The function, and the covariance if it is one."""
        functions = (self.observation, self.covariance)
        return tuple(f for f in functions if isinstance(f, Equation))

    def trace(
        self, values: Values, n_observables: int | None, flags: TensorVariable | None = None
    ) -> TracedObservation:
        """Call the functions with symbols; filters see to the ``flags`` beside Gaussian noise."""
        additive = "e" not in self.observation.symbols
        p = r = None
        if additive:
            seen = as_vector("observation", self.observation(values), n_observables)
            p = r = seen.type.shape[0]
        cov = trace_covariance("observation_noise", self.covariance, r, values)
        noise = pt.tensor("e", shape=(cov.type.shape[0],), dtype="float64")
        if additive:
            seen = seen + noise
        else:
            with_noise = {**values, "e": noise}
            seen = as_vector("observation", self.observation(with_noise), n_observables)
            p = seen.type.shape[0]
        if p == 0:
            raise ModelError("observation must return at least one expression, got none")
        datum = pt.tensor("d", shape=(p,), dtype="float64")
        return TracedObservation(noise, datum, seen, cov, additive=additive)


class DensityObservation:
    """Distributions, or a log-density with an observation function used in simulations only."""

    def __init__(
        self,
        observation: Callable | None,
        observation_noise: Any,
        dist: Callable | None,
        logp: Callable | None,
    ) -> None:
        if observation is None and observation_noise is not None:
            raise ModelError(
                "observation_noise must be None without an observation function, got "
                f"{observation_noise!r}"
            )
        self.simulated = (
            None if observation is None else GaussianObservation(observation, observation_noise)
        )
        self.dist = None
        if dist is not None:
            self.dist = _of_state(read_equation("observation_dist", dist, "xut"))
        self.logp = None
        if logp is not None:
            self.logp = _of_state(read_equation("observation_logp", logp, ("d", *"xut")))
            if "d" not in self.logp.symbols:
                raise ModelError("observation_logp must have the argument d, the observation")

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The density, then what only a simulation uses."""
        density = tuple(f for f in (self.dist, self.logp) if f is not None)
        return density if self.simulated is None else density + self.simulated.equations

    def trace(
        self, values: Values, n_observables: int | None, flags: TensorVariable | None = None
    ) -> TracedObservation:
        """Call the functions with symbols; for ``flags`` see `input_columns`."""
        if self.dist is not None:
            return _trace_distributions(self.dist, values, n_observables, flags)
        assert self.logp is not None
        if self.simulated is not None:
            seen = self.simulated.trace(values, n_observables)
            noise, datum = seen.noise, seen.datum
        else:
            seen = None
            noise = pt.tensor("e", shape=(0,), dtype="float64")
            datum = pt.tensor("d", shape=(n_observables or 1,), dtype="float64")
        logp = as_symbol("observation_logp", self.logp({**values, "d": datum}))
        if logp.type.ndim != 0:
            raise ModelError(
                f"observation_logp must return one number, got {logp.type.ndim} dimensions"
            )
        return TracedObservation(
            noise, datum, seen and seen.observation, seen and seen.covariance, logp=logp
        )


def _of_state(equation: Equation) -> Equation:
    """The equation, which must have the state: without it data say nothing of the state."""
    if "x" not in equation.symbols:
        raise ModelError(
            f"{equation.role} must have the argument x, the state, got the arguments "
            f"{[*equation.symbols, *equation.parameters]}: names other than "
            f"{', '.join(RESERVED)} are parameters"
        )
    return equation


def _trace_distributions(
    dist: Equation, values: Values, n_observables: int | None, flags: TensorVariable | None
) -> TracedObservation:
    returned = dist(values)
    variables = list(returned) if isinstance(returned, list | tuple) else [returned]
    if n_observables is not None and len(variables) != n_observables:
        raise ModelError(
            f"observation_dist must return {n_observables} distributions, one per observable, got "
            f"{len(variables)}"
        )
    datum = pt.tensor("d", shape=(len(variables),), dtype="float64")
    terms = [
        _log_density(variable, datum[i], None if flags is None else flags[i])
        for i, variable in enumerate(variables)
    ]
    return TracedObservation(
        noise=pt.tensor("e", shape=(0,), dtype="float64"),
        datum=datum,
        logp=pt.sum(pt.stack(terms)),
        draw=pt.stack([pt.cast(variable, "float64") for variable in variables]),
    )


def _with_slope_at_zero(logp: TensorVariable) -> TensorVariable:
    """The same, with a derivative where the mean of a count is zero: its logarithm has none."""
    logs = {}
    for node in io_toposort([], [logp]):
        if isinstance(node.op, Elemwise) and isinstance(node.op.scalar_op, ps.Log):
            (x,) = node.inputs
            is_zero = pt.eq(x, 0.0)
            logs[node.outputs[0]] = pt.switch(is_zero, -np.inf, pt.log(pt.switch(is_zero, 1.0, x)))
    return graph_replace([logp], logs, strict=False)[0] if logs else logp


def _log_density(
    variable: Any, value: TensorVariable, flag: TensorVariable | None
) -> TensorVariable:
    """The log-density of one component, 0 where it is missing: it is independent of the others.

    Of a censored one, the log of the probability of the side on which the ``flag`` says it lies.
    """
    if not isinstance(variable, TensorVariable) or variable.type.ndim != 0:
        raise ModelError(
            "observation_dist must return one scalar PyMC distribution per observable "
            f"([pm.Poisson.dist(mu=...)]), got {variable!r}"
        )
    if variable.owner is None:
        raise ModelError(f"observation_dist must return distributions, got {variable}")
    from pymc import logp  # the user has imported it

    missing = pt.isnan(value)
    # A number in place of NaN, which would survive in a gradient.
    value = pt.switch(missing, _ANY_VALUE, value)
    try:
        if "int" in variable.type.dtype:
            # A value that is not an integer has probability zero.
            whole = logp(variable, pt.cast(pt.round(value), variable.type.dtype))
            whole = _with_slope_at_zero(whole)
            there = pt.switch(pt.eq(value, pt.round(value)), whole, -float("inf"))
        else:
            there = logp(variable, value)
    except NotImplementedError as error:
        raise ModelError(
            f"observation_dist must return distributions with a log-density, got {variable}: "
            f"{error}"
        ) from error
    if flag is not None:
        below, above = _sides(variable, value, flag)
        there = pt.switch(pt.eq(flag, 0.0), there, pt.switch(pt.lt(flag, 0.0), below, above))
    return pt.switch(missing, 0.0, there)


def _sides(
    variable: TensorVariable, value: TensorVariable, flag: TensorVariable
) -> tuple[TensorVariable, TensorVariable]:
    """Logs of the probabilities of at most, and of at least, a value."""
    from pymc import logcdf

    values = (value, value)
    if is_count := "int" in variable.type.dtype:
        values = (pt.floor(value), pt.ceil(value) - 1.0)
    try:
        at_most, less = (
            logcdf(variable, pt.cast(one, variable.type.dtype) if is_count else one)
            for one in values
        )
    except NotImplementedError as error:
        raise ModelError(
            f"censored needs the distribution function of every observable, got {variable}, of "
            f"which PyMC has none: {error}; use another distribution"
        ) from error
    below, above = pt.lt(flag, 0.0), pt.gt(flag, 0.0)
    return _rewritten(at_most, below, contrary=False), _rewritten(less, above, contrary=True)


# Of functions that are probabilities, the probability of the contrary.
_CONTRARY = {
    GammaInc: pt.gammaincc,
    GammaIncC: pt.gammainc,
    BetaInc: lambda a, b, x: pt.betainc(b, a, 1.0 - x),
}


def _rewritten(log_p: TensorVariable, used: TensorVariable, *, contrary: bool) -> TensorVariable:
    """A log-probability that has a derivative where it is not ``used``, or that of the contrary.

    1 - p is written as p is, so that it keeps its digits where p is near one.
    """
    node = log_p.owner
    if isinstance(log_p, Constant):
        p = np.exp(log_p.data)
        return pt.constant(np.log1p(-p) if p < 1.0 else -np.inf) if contrary else log_p
    if node is not None and isinstance(node.op, CheckAndRaise):
        return node.op(_rewritten(node.inputs[0], used, contrary=contrary), *node.inputs[1:])
    kind = type(node.op.scalar_op) if node is not None and isinstance(node.op, Elemwise) else None
    if kind is ps.Switch:
        branches = (_rewritten(branch, used, contrary=contrary) for branch in node.inputs[1:])
        return pt.switch(node.inputs[0], *branches)
    if kind is ps.Log:
        (p,) = node.inputs
        known = getattr(getattr(p.owner, "op", None), "scalar_op", None)
        if contrary and type(known) in _CONTRARY:
            p, contrary = _CONTRARY[type(known)](*p.owner.inputs), False
        p = pt.switch(used, p, 0.5)
        return pt.log1p(-p) if contrary else pt.log(p)
    if kind is ps.Log1p and contrary:
        return pt.log(pt.switch(used, -node.inputs[0], 0.5))
    if kind is Log1mexp:
        log_q = pt.switch(used, node.inputs[0], -1.0)
        return log_q if contrary else pt.log1mexp(log_q)
    return pt.log1mexp(pt.switch(used, log_p, -1.0)) if contrary else log_p
