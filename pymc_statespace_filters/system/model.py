"""The system: what the user wrote, traced once, checked once, immutable from then on."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.equations import (
    Equation,
    as_matrix,
    as_vector,
    constant_covariance,
    positive,
    read_equation,
)
from pymc_statespace_filters.system.graph_digest import describe, freeze
from pymc_statespace_filters.system.observation import Observation, read_observation
from pymc_statespace_filters.system.signature import (
    carried_names,
    check_defaults,
    checked_names,
    parameter_names,
    parameter_symbols,
    shapes_of,
    size_of,
)


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


class StateSpaceModel:
    r"""A dynamical system that is observed now and then.

    .. math::
        x_{k+1} &= g(x_k, q_k, u_k, t_k), \quad q_k \sim N(0, Q) \\
        d_j &= h(x_{d(j)}, e_j), \quad e_j \sim N(0, \Gamma), \qquad x_0 \sim N(m_0, P_0)

    (thesis, Eqs. 3.10-3.11). Functions are ordinary Python on PyTensor symbols and are called
    once. Five argument names are reserved and passed by name, in any order, only if asked for:
    ``x`` (state), ``q`` (process noise), ``e`` (measurement noise), ``u`` (inputs at this step)
    and ``t`` (time). Every other argument is a parameter; a default makes it optional.

    What you write: a transition, an observation, their noises, the initial state.
    What you get: ``parameters`` (names in order of appearance), equality of systems by their
    equations, and every filter, simulation and PyMC variable of this package.

    Parameters
    ----------
    transition : EulerMaruyama or callable
        An integrator, or ``g(x, q, u, t, ...)`` returning the next state.
    observation : callable, optional
        ``h(x, u, t, ...)``: additive noise of covariance ``observation_noise``, shape (p, p).
        With an argument ``e``: general noise of covariance (r, r); densities then use
        ``D Gamma D^T`` at ``e = 0`` (Eq. 4.4), an approximation.
    observation_noise, process_noise : array_like or callable
        COVARIANCES, or functions of parameters only that return them.
    observation_dist : callable, optional
        ``f(x, ...)`` returning one PyMC distribution per observable, independent given ``x``.
    observation_logp : callable, optional
        ``f(d, x, ...)`` returning the log-density of one observation ``d``, shape (p,).
    dt : float, optional
        Length of a step of a transition given as a function; default 1.
    initial_mean, initial_cov : array_like or callable
        Mean (n,) and covariance (n, n) of the state at step 0; the covariance may be singular.
    states, observables, inputs : sequence of str, optional
        Names; ``inputs`` fixes the length of ``u``.
    shapes : mapping, optional
        Shapes of parameters that are not scalars, ``{"k": (2,)}``.
    carried : sequence of str
        States that no Kalman update touches (discrete memory); copied with their particle.

    Raises
    ------
    ModelError
        If anything disagrees; the message names the argument, its value and what is expected.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(
    ...         lambda x, alpha, beta: [alpha * x[0] + beta * x[0] ** 3], [[0.6]], dt=0.01
    ...     ),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.08]],
    ...     initial_mean=[1.0],
    ...     initial_cov=[[0.5]],
    ... )
    >>> system.parameters
    ('alpha', 'beta')
    """

    def __init__(
        self,
        transition: Any,
        observation: Callable | None = None,
        *,
        observation_noise: Any = None,
        observation_dist: Callable | None = None,
        observation_logp: Callable | None = None,
        process_noise: Any = None,
        dt: float | None = None,
        initial_mean: Any,
        initial_cov: Any,
        states: Sequence[str] | None = None,
        observables: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        shapes: Mapping[str, Sequence[int]] | None = None,
        carried: Sequence[str] = (),
    ) -> None:
        given = {name: value for name, value in locals().items() if name != "self"}
        step = _transition(transition, process_noise, dt)
        seen = read_observation(observation, observation_noise, observation_dist, observation_logp)
        noise = _covariance("process_noise", process_noise)
        mean = _initial_mean(initial_mean)
        cov = _covariance("initial_cov", initial_cov)
        covariances = [e for e in (noise, mean, cov) if isinstance(e, Equation)]
        equations = [*step.equations, *seen.equations, *covariances]

        names, defaults = parameter_names(equations)
        parameter_shapes = shapes_of(names, shapes)
        check_defaults(defaults, names, parameter_shapes)
        n_inputs = len(checked_names("inputs", inputs, None))
        if n_inputs == 0 and any("u" in e.symbols for e in equations):
            asking = next(e.role for e in equations if "u" in e.symbols)
            raise ModelError(f'{asking} asks for u, but no inputs are named; give inputs=["..."]')

        theta = pt.tensor("theta", shape=(sum(map(size_of, parameter_shapes)),), dtype="float64")
        values = parameter_symbols(theta, names, parameter_shapes)
        m0 = as_vector("initial_mean", mean(values) if isinstance(mean, Equation) else mean)
        n = m0.type.shape[0]
        if n == 0:
            raise ModelError("initial_mean is empty: a system has at least one state")
        values |= {
            "x": pt.tensor("x", shape=(n,), dtype="float64"),
            "u": pt.tensor("u", shape=(n_inputs,), dtype="float64"),
            "t": pt.tensor("t", shape=(), dtype="float64"),
        }
        m = step.noise_size(values) if noise is None else _noise_size(noise, values)
        values["q"] = pt.tensor("q", shape=(m,), dtype="float64")
        traced: Observation = seen.trace(values, None if observables is None else len(observables))
        symbols = [theta, *(values[s] for s in "xqut"), traced.noise, traced.datum]
        cov_of = {"process_noise": (noise, m), "initial_cov": (cov, n)}
        covs = {
            role: _covariance_graph(role, c, size, values) for role, (c, size) in cov_of.items()
        }

        def frozen(output: TensorVariable | None) -> FrozenFunctionGraph | None:
            return None if output is None else freeze(symbols, [output])

        self._set(
            parameters=names,
            defaults=defaults,
            parameter_shapes=parameter_shapes,
            dt=float(step.dt),
            n=n,
            m=m,
            p=traced.datum.type.shape[0],
            r=traced.noise.type.shape[0],
            n_inputs=n_inputs,
            states=checked_names("states", states, [f"x{i}" for i in range(n)]),
            observables=checked_names(
                "observables", observables, [f"y{i}" for i in range(traced.datum.type.shape[0])]
            ),
            inputs=checked_names("inputs", inputs, None),
            additive_noise=traced.additive,
            gaussian_observation=traced.gaussian,
            observation_uses_inputs=any("u" in e.symbols for e in seen.equations),
            equations=Equations(
                transition=frozen(as_vector("transition", step.step(values), n)),
                process_noise=frozen(covs["process_noise"]),
                observation=frozen(traced.observation),
                observation_noise=frozen(traced.covariance),
                observation_logp=frozen(traced.logp),
                observation_draw=traced.freeze_draw(symbols),
                initial_mean=frozen(m0),
                initial_cov=frozen(covs["initial_cov"]),
            ),
        )
        self._set(carried=carried_names(carried, self.states))
        # No part of what a system is: neither compared nor pickled.
        self._set(_given=given)

    # Attributes are set once, here; the class annotations are what a system is made of.
    parameters: tuple[str, ...]
    defaults: tuple[tuple[str, Any], ...]
    parameter_shapes: tuple[tuple[int, ...], ...]
    dt: float
    n: int
    m: int
    p: int
    r: int
    n_inputs: int
    states: tuple[str, ...]
    observables: tuple[str, ...]
    inputs: tuple[str, ...]
    carried: tuple[str, ...]
    additive_noise: bool
    gaussian_observation: bool
    observation_uses_inputs: bool
    equations: Equations

    def _set(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a system is immutable; make a new one to change {name!r}")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"a system is immutable; {name!r} cannot be deleted")

    def _identity(self) -> tuple:
        return tuple(self.__dict__[name] for name in StateSpaceModel.__annotations__)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StateSpaceModel):
            return NotImplemented
        return self is other or self._identity() == other._identity()

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self._identity())

    def __getstate__(self) -> dict[str, Any]:
        # Hashes of graphs differ between processes.
        return {name: self.__dict__[name] for name in StateSpaceModel.__annotations__}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._set(**state)

    def __repr__(self) -> str:
        return (
            f"StateSpaceModel(states={list(self.states)}, observables={list(self.observables)}, "
            f"parameters={list(self.parameters)}, dt={self.dt:g})"
        )

    @property
    def integrator(self) -> Any:
        """The integrator behind the transition.

        None for a transition that is a function, and for a system out of a pickle, which holds the
        traced equations alone.
        """
        transition = self.__dict__.get("_given", {}).get("transition")
        return transition if hasattr(transition, "step") else None

    def with_integrator(self, integrator: Any) -> "StateSpaceModel":
        """The same system by another integrator; only where it has one."""
        return StateSpaceModel(**self.__dict__["_given"] | {"transition": integrator})

    @property
    def n_theta(self) -> int:
        """Length of the flat parameter vector."""
        return sum(map(size_of, self.parameter_shapes))

    @cached_property
    def fingerprint(self) -> str:
        """A digest of the equations and settings, the same in every process."""
        settings = [repr(v) for v in self._identity()[:-1]]
        graphs = [describe(graph) for graph in vars(self.equations).values()]
        return hashlib.sha256("\n".join([*settings, *graphs]).encode()).hexdigest()


@dataclass(frozen=True)
class _Map:
    """A transition written as a function ``g(x, q, u, t, ...)``."""

    equation: Equation
    dt: float

    @property
    def equations(self) -> tuple[Equation, ...]:
        return (self.equation,)

    def noise_size(self, values: Mapping[str, TensorVariable]) -> int:
        if "q" in self.equation.symbols:
            raise ModelError("transition asks for q, but process_noise (its covariance) is missing")
        return 0

    def step(self, values: Mapping[str, TensorVariable]) -> TensorVariable:
        return as_vector("transition", self.equation(values))


def _transition(transition: Any, process_noise: Any, dt: float | None) -> Any:
    if hasattr(transition, "step") and hasattr(transition, "noise_size"):
        if process_noise is not None:
            raise ModelError(
                "process_noise is given beside an integrator, which brings its own (the diffusion)"
            )
        if dt is not None:
            raise ModelError(f"dt={dt!r} is given beside an integrator, which has its own dt")
        positive("dt", transition.dt)
        return transition
    equation = read_equation("transition", transition, "xqut")
    if process_noise is not None and "q" not in equation.symbols:
        raise ModelError(
            "process_noise is given, but the transition does not ask for q, the process noise"
        )
    return _Map(equation, positive("dt", 1.0 if dt is None else dt))


def _initial_mean(value: Any) -> Any:
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


def _covariance(role: str, value: Any) -> Any:
    if value is None or not callable(value):
        return value
    return read_equation(role, value, "")


def _noise_size(noise: Any, values: Mapping[str, TensorVariable]) -> int:
    if isinstance(noise, Equation):
        return as_matrix("process_noise", noise(values)).type.shape[0]
    return constant_covariance("process_noise", noise, None, definite=False).shape[0]


def _covariance_graph(
    role: str, covariance: Any, size: int, values: Mapping[str, TensorVariable]
) -> TensorVariable | None:
    if covariance is None:
        return None  # the noise of an integrator: standard normals
    if isinstance(covariance, Equation):
        return as_matrix(role, covariance(values), size, size)
    return pt.as_tensor(constant_covariance(role, covariance, size, definite=False))
