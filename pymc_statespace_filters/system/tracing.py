"""From the functions of a system to its frozen graphs, in four steps: read, size, trace, freeze.

`read` checks the functions and their signatures, `size` makes the symbols, whose lengths follow
from the initial mean and the noises, `trace` calls the functions with these symbols, and
`freeze_equations` makes immutable graphs of what they return.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.checks import check_positive
from pymc_statespace_filters.system.equations import (
    Equation,
    as_matrix,
    as_vector,
    constant_covariance,
    read_equation,
)
from pymc_statespace_filters.system.graph_digest import freeze
from pymc_statespace_filters.system.integrators import Integrator
from pymc_statespace_filters.system.observation import (
    DensityObservation,
    GaussianObservation,
    TracedObservation,
    read_observation,
)
from pymc_statespace_filters.system.signature import (
    Signature,
    parameter_symbols,
    read_signature,
    size_of,
)

Values = Mapping[str, TensorVariable]


@dataclass(frozen=True)
class Functions:
    """The functions and numbers of a system, read and not called yet."""

    transition: "Integrator | FunctionTransition"
    observation: GaussianObservation | DensityObservation
    process_noise: Any
    initial_mean: Any
    initial_cov: Any

    @property
    def equations(self) -> list[Equation]:
        """The user's functions, in the order in which their parameters are listed."""
        others = (self.process_noise, self.initial_mean, self.initial_cov)
        covariances = [other for other in others if isinstance(other, Equation)]
        return [*self.transition.equations, *self.observation.equations, *covariances]


@dataclass(frozen=True)
class Symbols:
    """The symbols that the functions are called with: all parameters in one vector, and by name."""

    theta: TensorVariable
    values: Values
    initial_mean: TensorVariable

    @property
    def n(self) -> int:
        """Number of states."""
        return self.values["x"].type.shape[0]

    @property
    def m(self) -> int:
        """Number of process noises."""
        return self.values["q"].type.shape[0]


@dataclass(frozen=True)
class Traced:
    """What the functions return, as expressions of the symbols."""

    transition: TensorVariable
    process_noise: TensorVariable | None
    observation: TracedObservation
    initial_cov: TensorVariable | None


@dataclass(frozen=True)
class Equations:
    """The traced functions of a system, each a frozen graph of the symbols in ``SYMBOLS``."""

    transition: FrozenFunctionGraph
    process_noise: FrozenFunctionGraph | None
    observation: FrozenFunctionGraph | None
    observation_noise: FrozenFunctionGraph | None
    observation_logp: FrozenFunctionGraph | None
    observation_draw: FrozenFunctionGraph | None
    initial_mean: FrozenFunctionGraph
    initial_cov: FrozenFunctionGraph


def read(
    *,
    transition: Any,
    process_noise: Any,
    dt: float | None,
    observation: Callable | None,
    observation_noise: Any,
    observation_dist: Callable | None,
    observation_logp: Callable | None,
    initial_mean: Any,
    initial_cov: Any,
) -> Functions:
    """Check the functions of a system one by one; nothing is called."""
    return Functions(
        _read_transition(transition, process_noise, dt),
        read_observation(observation, observation_noise, observation_dist, observation_logp),
        _read_covariance("process_noise", process_noise),
        _read_initial_mean(initial_mean),
        _read_covariance("initial_cov", initial_cov),
    )


def size(functions: Functions, signature: Signature) -> Symbols:
    """Make the symbols; parameters come first, for the lengths of the others depend on them."""
    n_theta = sum(map(size_of, signature.shapes))
    theta = pt.tensor("theta", shape=(n_theta,), dtype="float64")
    values = parameter_symbols(theta, signature.parameters, signature.shapes)
    mean = functions.initial_mean
    m0 = as_vector("initial_mean", mean(values) if isinstance(mean, Equation) else mean)
    n = m0.type.shape[0]
    if n == 0:
        raise ModelError("initial_mean must have an entry for at least one state, got none")
    values |= {
        "x": pt.tensor("x", shape=(n,), dtype="float64"),
        "u": pt.tensor("u", shape=(len(signature.inputs),), dtype="float64"),
        "t": pt.tensor("t", shape=(), dtype="float64"),
    }
    m = _noise_size(functions, values)
    return Symbols(theta, values | {"q": pt.tensor("q", shape=(m,), dtype="float64")}, m0)


def trace(functions: Functions, symbols: Symbols, observables: Sequence[str] | None) -> Traced:
    """Call the functions with the symbols."""
    values, n, m = symbols.values, symbols.n, symbols.m
    n_observables = None if observables is None else len(observables)
    observation = functions.observation.trace(values, n_observables)
    process_noise = _trace_covariance("process_noise", functions.process_noise, m, values)
    initial_cov = _trace_covariance("initial_cov", functions.initial_cov, n, values)
    transition = as_vector("transition", functions.transition.step(values), n)
    return Traced(transition, process_noise, observation, initial_cov)


def freeze_equations(symbols: Symbols, traced: Traced) -> Equations:
    """Immutable graphs of everything that was traced, all with the same inputs."""
    seen = traced.observation
    inputs = [symbols.theta, *(symbols.values[name] for name in "xqut"), seen.noise, seen.datum]

    def frozen(output: TensorVariable | None) -> FrozenFunctionGraph | None:
        return None if output is None else freeze(inputs, [output])

    return Equations(
        transition=freeze(inputs, [traced.transition]),
        process_noise=frozen(traced.process_noise),
        observation=frozen(seen.observation),
        observation_noise=frozen(seen.covariance),
        observation_logp=frozen(seen.logp),
        observation_draw=seen.freeze_draw(inputs),
        initial_mean=freeze(inputs, [symbols.initial_mean]),
        initial_cov=frozen(traced.initial_cov),
    )


def signature_of(
    functions: Functions,
    shapes: Mapping[str, Sequence[int]] | None,
    inputs: Sequence[str] | None,
) -> Signature:
    """Names, defaults and shapes of the parameters, and the names of the inputs."""
    signature = read_signature(functions.equations, shapes, inputs)
    with_inputs = [e.role for e in functions.equations if "u" in e.symbols]
    if with_inputs and not signature.inputs:
        raise ModelError(
            f"{with_inputs[0]} has the argument u, so inputs must name the inputs "
            f'(inputs=["..."]), got {inputs!r}'
        )
    return signature


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
        """Number of process noises where no covariance says it: none."""
        if "q" in self.equation.symbols:
            raise ModelError(
                "process_noise must be the covariance of q, an argument of transition, got None"
            )
        return 0

    def step(self, values: Values) -> TensorVariable:
        """The next state."""
        return as_vector("transition", self.equation(values))


def _read_transition(
    transition: Any, process_noise: Any, dt: float | None
) -> Integrator | FunctionTransition:
    if isinstance(transition, Integrator):
        if process_noise is not None:
            raise ModelError(
                "process_noise must be None beside an integrator, which has a diffusion, "
                f"got {process_noise!r}"
            )
        if dt is not None:
            raise ModelError(
                f"dt must be None beside an integrator, which has its own, got dt={dt!r}"
            )
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
    return FunctionTransition(equation, check_positive("dt", 1.0 if dt is None else dt))


def _read_initial_mean(value: Any) -> Any:
    if callable(value):
        return read_equation("initial_mean", value, "")
    try:
        mean = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"initial_mean must be numbers or a function, got {value!r}") from None
    if mean.ndim != 1 or not np.isfinite(mean).all():
        raise ModelError(
            f"initial_mean must be a finite vector, one entry per state, got {value!r}"
        )
    return mean


def _read_covariance(role: str, value: Any) -> Any:
    return read_equation(role, value, "") if callable(value) else value


def _noise_size(functions: Functions, values: Values) -> int:
    noise = functions.process_noise
    if noise is None:
        return functions.transition.noise_size(values)
    if isinstance(noise, Equation):
        return as_matrix("process_noise", noise(values)).type.shape[0]
    return constant_covariance("process_noise", noise, None, definite=False).shape[0]


def _trace_covariance(
    role: str, covariance: Any, size: int, values: Values
) -> TensorVariable | None:
    if covariance is None:
        return None  # the noise of an integrator: standard normals
    if isinstance(covariance, Equation):
        return as_matrix(role, covariance(values), size, size)
    return pt.as_tensor(constant_covariance(role, covariance, size, definite=False))
