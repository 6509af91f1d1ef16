"""The system: a user's functions, traced once and checked; immutable."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph

from ..errors import ModelError
from .drift import DriftingParameter, held_for
from .graph_digest import describe, digest
from .integrators.protocol import Integrator, bound_to_states
from .labels import default_names
from .readers import observables_that_read
from .signature import (
    check_names_of_events,
    checked_events,
    checked_names,
    names_of_states,
    read_signature,
    size_of,
)
from .tracing import INPUT_ROW, Equations, read, size, trace

# What a system keeps beside its fields, to trace it again.
_AS_WRITTEN = ("_written", "_settings")


@dataclass(init=False, repr=False)
class StateSpaceModel:
    r"""A discrete-time dynamical system, observed at some of its steps.

    .. math::
        x_{k+1} &= g(x_k, q_k, u_k, t_k), \quad q_k \sim N(0, Q) \\
        d_j &= h(x_{d(j)}, e_j), \quad e_j \sim N(0, \Gamma), \qquad x_0 \sim N(m_0, P_0)

    (thesis, Eqs. 3.10-3.11). Functions are ordinary Python functions of PyTensor symbols and are
    called once. A vector of one component and a matrix of one element may be given or returned as
    a scalar. Five argument names are reserved: ``x`` (state), ``q`` (process noise), ``e``
    (measurement noise), ``u`` (inputs at this step) and ``t`` (time). They are passed by name, in
    any order, to the functions that have them as arguments. Every other argument is a parameter; a
    default makes it optional.

    Systems are immutable, equal if their equations and settings are equal, hashable and picklable.
    The attribute ``parameters`` lists the names of the parameters in order of appearance.

    Parameters
    ----------
    transition : EulerMaruyama, another integrator, or callable
        An integrator, or ``g(x, q, u, t, ...)`` returning the next state.
    observation : callable, optional
        ``h(x, u, t, ...)``, with additive noise of covariance ``observation_noise``, shape (p, p).
        With an argument ``e``, noise of covariance (r, r) enters in any form; densities then use
        ``D Gamma D^T`` at ``e = 0`` (Eq. 4.4), an approximation.
    observation_noise, process_noise : array_like or callable
        Covariances (not standard deviations), or functions of parameters that return them; that of
        the observation may have the arguments ``u`` and ``t``, for a known error bar of each
        observation. With a variance of zero a sensor is exact, which only `EKF` and `UKF` take.
    process_dist : callable, optional
        ``f(x, u, t, ...)`` returning a list of PyMC distributions in place of ``process_noise``:
        the components of ``q``, drawn at every step given the present state. Vectors such as
        ``pm.Multinomial.dist`` contribute their components, and variables may be parameters of
        others. `BootstrapPF` draws from them; `EKF`, `UKF`, `IPLF` and `EnKF` have normal variables
        of the same means and variances.
    observation_dist : callable, optional
        ``f(x, ...)`` returning one PyMC distribution per observable, independent given ``x``.
    observation_logp : callable, optional
        ``f(d, x, ...)`` returning the log-density of one observation ``d``, shape (p,), in which a
        missing component is NaN.
    dt : float, optional
        Length of a step where the transition is a function; default 1.
    initial_mean, initial_cov : array_like or callable
        Mean (n,) and covariance (n, n) of the state at step 0; the covariance may be singular.
    initial_dist : callable, optional
        ``f(...)`` returning a list in place of both, one entry per state: a PyMC distribution, a
        number, or an expression of parameters and of other entries.
    states, observables, inputs : sequence of str, optional
        Names; ``inputs`` fixes the length of ``u``.
    shapes : mapping, optional
        Shapes of parameters that are not scalars, ``{"k": (2,)}``.
    carried : sequence of str
        States that no Kalman update touches (discrete memory); copied with their particle.
    accumulators : sequence of str
        States that are zero again right after an observation, such as the cases of a week. At an
        observation a state has its value before that.
    resets : {"seen", "row"}
        When that is: where an observable that depends on the accumulator is not missing, the
        default, for a value that counts all since the last one, as a quarterly sum among months;
        or in every row, also one of NaN, for a value that counts since the row before.
    event : callable, optional
        ``f(x, u, t, ...)`` returning the state after an event, such as a dose, a refill or an
        impact, at times that the data give (``events`` of `StateSpace`). An observation at the time
        of an event sees the state before it, unless the data say otherwise.
    events : sequence of str
        Arguments of ``event`` that the data give for each, such as the amount of a dose.

    Raises
    ------
    ModelError
        If an argument is wrong; the message names it, its value and what is expected.

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
        process_dist: Callable | None = None,
        dt: float | None = None,
        initial_mean: Any = None,
        initial_cov: Any = None,
        initial_dist: Callable | None = None,
        states: Sequence[str] | None = None,
        observables: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        shapes: Mapping[str, Sequence[int]] | None = None,
        carried: Sequence[str] = (),
        accumulators: Sequence[str] = (),
        resets: str | None = None,
        event: Callable | None = None,
        events: Sequence[str] = (),
    ) -> None:
        self._trace(
            {
                "transition": bound_to_states(transition, states),
                "observation": observation,
                "observation_noise": observation_noise,
                "observation_dist": observation_dist,
                "observation_logp": observation_logp,
                "process_noise": process_noise,
                "process_dist": process_dist,
                "dt": dt,
                "initial_mean": initial_mean,
                "initial_cov": initial_cov,
                "initial_dist": initial_dist,
                "event": event,
                "events": checked_events(event, events),
            },
            states=states,
            observables=observables,
            inputs=inputs,
            shapes=shapes,
            carried=carried,
            accumulators=accumulators,
            resets=resets,
        )

    def _trace(
        self,
        written: Mapping[str, Any],
        *,
        states: Sequence[str] | None,
        observables: Sequence[str] | None,
        inputs: Sequence[str] | None,
        shapes: Mapping[str, Sequence[int]] | None,
        carried: Sequence[str],
        accumulators: Sequence[str],
        resets: str | None,
        drifting: Sequence[DriftingParameter] = (),
        at_any_times: bool = False,
        n_censored: int = 0,
    ) -> None:
        """Set all fields, from what the user wrote."""
        functions = read(**written)
        signature = read_signature(functions.equations, shapes, inputs).with_drift(drifting)
        check_names_of_events(written["events"], signature.parameters)
        symbols = size(
            functions,
            signature,
            drifting,
            n_accumulators=len(accumulators),
            at_any_times=at_any_times,
            events=written["events"],
            n_censored=n_censored,
        )
        state_names = checked_names("states", states, default_names("x", symbols.n_written))
        state_names += tuple(one.name for one in drifting)
        totals = names_of_states("accumulators", accumulators, state_names)
        equations, seen = trace(
            functions, symbols, observables, [state_names.index(name) for name in totals]
        )
        p, r = seen.datum.type.shape[0], seen.noise.type.shape[0]
        # Of a system at any times, the time of a step is in a column of inputs.
        from_inputs = {"u", "t"} if at_any_times else {"u"}
        self._set(
            parameters=signature.parameters,
            defaults=signature.defaults,
            parameter_shapes=signature.shapes,
            dt=float(functions.transition.dt),
            n=symbols.n,
            m=symbols.m,
            p=p,
            r=r,
            n_inputs=len(signature.inputs),
            states=state_names,
            observables=checked_names("observables", observables, default_names("y", p)),
            inputs=signature.inputs,
            carried=names_of_states("carried", carried, state_names),
            accumulators=totals,
            resets=_checked_resets(resets),
            events=None if functions.event is None else written["events"],
            drifting=tuple(drifting),
            additive_noise=seen.additive,
            discrete_noise=symbols.drawn is not None and symbols.drawn.is_discrete,
            gaussian_observation=seen.gaussian and not n_censored,
            observation_uses_inputs=n_censored > 0
            or any(from_inputs.intersection(e.symbols) for e in functions.observation.equations),
            observation_has_u=any("u" in e.symbols for e in functions.observation.equations),
            keeps_noises=False,
            equations=equations,
            known=(),
            has_instant_steps=False,
        )
        names = {"states": states, "observables": observables, "inputs": inputs}
        others = {
            "shapes": shapes,
            "carried": carried,
            "accumulators": accumulators,
            "resets": resets,
            "drifting": drifting,
        }
        # To trace it again, with another integrator or at any times: neither compared nor pickled.
        self._set(_written=written, _settings=names | others)

    # Equality and hash are those of the fields, which `__init__` sets once.
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
    accumulators: tuple[str, ...]
    resets: str
    drifting: tuple[DriftingParameter, ...]
    additive_noise: bool
    discrete_noise: bool
    gaussian_observation: bool
    observation_uses_inputs: bool
    observation_has_u: bool
    keeps_noises: bool
    equations: Equations
    # Elements of the flat parameters that a model fixes, and their numbers.
    known: tuple[tuple[int, float], ...] = ()
    # Names of the numbers of an event; None without events.
    events: tuple[str, ...] | None = None
    # Whether the data have events before an observation at the same time.
    has_instant_steps: bool = False

    def _set(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a system is immutable; make a new one to change {name!r}")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"a system is immutable; {name!r} cannot be deleted")

    def __getstate__(self) -> dict[str, Any]:
        # The fields alone, without the cached hash: hashes of graphs differ between processes.
        return {field.name: self.__dict__[field.name] for field in fields(self)}

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(tuple(self.__getstate__().values()))

    def __repr__(self) -> str:
        return (
            f"StateSpaceModel(states={list(self.states)}, observables={list(self.observables)}, "
            f"parameters={list(self.parameters)}, dt={self.dt:g})"
        )

    @property
    def integrator(self) -> Integrator | None:
        """The integrator behind the transition.

        None where the transition is a function, and after unpickling: a pickle holds the traced
        equations alone.
        """
        transition = self.__dict__.get("_written", {}).get("transition")
        return transition if isinstance(transition, Integrator) else None

    @property
    def has_gaussian_steps(self) -> bool:
        """Whether a step is a function of Gaussian noise: no distribution is another one."""
        return self.equations.gaussian_transition is None

    @property
    def has_gaussian_start(self) -> bool:
        """Whether the state at step 0 is Gaussian."""
        return self.equations.initial_draw is None

    @cached_property
    def with_gaussian_steps(self) -> "StateSpaceModel":
        """The system with normal variables of the same means and variances in ``process_dist``.

        Itself where they are normal. Variances are those given the state and the variables above.
        """
        transition = self.equations.gaussian_transition
        if transition is None:
            return self
        steps = {"transition": transition, "gaussian_transition": None, "finite_step": None}
        # Of an infinite variance even the root is large: its square, in a sum of noises, overflows.
        return self._with_equations(steps)._with(discrete_noise=False, keeps_noises=True)

    @cached_property
    def gaussian(self) -> "StateSpaceModel":
        """The system `with_gaussian_steps` and with a Gaussian start of the same moments."""
        system = self.with_gaussian_steps
        if system.has_gaussian_start:
            return system
        return system._with_equations({"initial_draw": None, "finite_start": None})

    def with_known(self, known: tuple[tuple[int, float], ...]) -> "StateSpaceModel":
        """The same system where these elements of the flat parameters have these numbers.

        Its equations are as they were, so that nothing is compiled anew; see `folded`.
        """
        return self if known == self.known else self._with_data(known=known)

    def with_instant_steps(self, has_instant_steps: bool = True) -> "StateSpaceModel":
        """The same system for data in which some steps have no length, so no noise."""
        if has_instant_steps == self.has_instant_steps:
            return self
        return self._with_data(has_instant_steps=has_instant_steps)

    @cached_property
    def folded(self) -> "StateSpaceModel":
        """The system with the known numbers in its equations: what they are then can be asked."""
        if not self.known:
            return self
        theta, known = self.equations.transition.inputs[0].type("theta"), dict(self.known)
        numbers = pt.stack([pt.constant(known[i]) if i in known else theta[i]
                            for i in range(self.n_theta)])  # fmt: skip
        folded = {}
        for name, graph in vars(self.equations).items():
            if isinstance(graph, FrozenFunctionGraph):
                others = [v.type() for v in graph.inputs[1:]]
                outputs = graph.bind([numbers, *others])
                folded[name] = FrozenFunctionGraph.from_io([theta, *others], outputs)
        return self._with_equations(folded)._with(known=())

    def _with_equations(self, equations: Mapping[str, Any]) -> "StateSpaceModel":
        return self._with(equations=replace(self.equations, **equations))

    def _with(self, **attributes: Any) -> "StateSpaceModel":
        system = object.__new__(StateSpaceModel)
        system._set(**self.__getstate__() | attributes)
        return system

    def _with_data(self, **attributes: Any) -> "StateSpaceModel":
        """The same equations with other facts of the data, which can be traced again."""
        own = {name: value for name, value in self.__dict__.items() if name in _AS_WRITTEN}
        system = self._with(**attributes)
        system._set(**own)
        return system

    def with_integrator(
        self, integrator: Integrator, *, keeps_noises: bool = False
    ) -> "StateSpaceModel":
        """The same system with another integrator.

        If it ``keeps_noises``, a filter draws every noise, where it would draw the sum of several
        that act on one state. Two such systems with equally many noises then have the same ones.
        """
        if self.integrator is None:
            raise ModelError(f"{self!r} must have an integrator, got a transition without one")
        system = self._traced_again(self.is_at_any_times, transition=integrator)
        system._set(keeps_noises=keeps_noises)
        return system

    @cached_property
    def at_any_times(self) -> "StateSpaceModel":
        """The same system with steps of any length, which is a column of inputs, as is their time.

        See `input_columns`.
        """
        if self.is_at_any_times:
            return self
        system = self._traced_again(True)
        system._set(keeps_noises=self.keeps_noises)
        return system

    @cached_property
    def censored(self) -> "StateSpaceModel":
        """The same system with flags of censored values as columns of inputs.

        See `input_columns`.
        """
        if self.is_censored:
            return self
        if self.equations.observation_draw is None and self.equations.observation_logp is not None:
            raise ModelError(
                "censored needs the probability that an observation lies below a value, which "
                "observation_logp does not give: use observation or observation_dist, or write the "
                "probability in observation_logp and read flags from inputs"
            )
        if "_written" not in self.__dict__:
            raise ModelError(
                "system must not have been unpickled where values are censored, for "
                "its functions are needed"
            )
        system = self._traced_again(self.is_at_any_times, n_censored=self.p)
        system._set(keeps_noises=self.keeps_noises)
        return system

    @property
    def is_censored(self) -> bool:
        """Whether flags of censored values are columns of inputs."""
        return self.equations.censoring is not None

    @property
    def why_one_length(self) -> str | None:
        """Why the steps of this system have one length; None if they may have any."""
        integrator = self.integrator
        if self.is_at_any_times or hasattr(integrator, "at_length"):
            return None
        if integrator is not None:
            return f"{type(integrator).__name__} has no steps of other lengths (at_length)"
        if "_written" not in self.__dict__:
            return "the steps of a system that was unpickled have one length"
        return "the steps of a transition that is a function have one length"

    def with_drifting(self, drifting: Sequence[DriftingParameter]) -> "StateSpaceModel":
        """The same system in which these parameters are states, and no others."""
        if "_written" not in self.__dict__:
            raise ModelError(
                "system must not have been unpickled, for its functions are needed: let parameters "
                "drift before the system is pickled"
            )
        return self._traced_again(self.is_at_any_times, drifting=tuple(drifting))

    def check_drifting(self, names: Sequence[str]) -> None:
        """Raise unless all these parameters are of equations that hold at every step."""
        if "_written" not in self.__dict__:
            return
        functions = read(**self.__dict__["_written"])
        of_steps = {name for e in functions.equations_of_steps for name in e.parameters}
        for name in names:
            if name not in of_steps:
                raise ModelError(
                    f"{name} must be a parameter of a step or an observation to drift, got one of "
                    "the start alone"
                )

    def _traced_again(
        self,
        at_any_times: bool,
        drifting: tuple[DriftingParameter, ...] | None = None,
        n_censored: int | None = None,
        **changes: Any,
    ) -> "StateSpaceModel":
        system = object.__new__(StateSpaceModel)
        own = self.__dict__
        settings = own["_settings"]
        if drifting is not None:
            settings = settings | {"drifting": drifting}
        n_censored = self.is_censored * self.p if n_censored is None else n_censored
        system._trace(
            own["_written"] | changes, **settings, at_any_times=at_any_times, n_censored=n_censored
        )
        system._set(known=self.known, has_instant_steps=self.has_instant_steps)
        return system

    @property
    def n_input_columns(self) -> int:
        """Number of inputs, and of the columns behind them, see `input_columns`."""
        return self.equations.transition.inputs[INPUT_ROW].type.shape[0]

    @property
    def is_at_any_times(self) -> bool:
        """Whether length and time of a step are columns of inputs."""
        other = len(self.held_for) + self.n_step_columns + len(self.accumulators)
        return self.n_input_columns > self.n_inputs + other

    @property
    def n_step_columns(self) -> int:
        """Number of the columns of a `TimeAxis`: those of an event, and flags of censored data."""
        return (0 if self.events is None else 1 + len(self.events)) + self.is_censored * self.p

    @property
    def names_resets(self) -> bool:
        """Whether the user said when accumulators are reset."""
        return self.__dict__.get("_settings", {}).get("resets", "") is not None

    @cached_property
    def readers(self) -> np.ndarray:
        """Which observables (p, accumulators) read an accumulator, see `observables_that_read`."""
        return observables_that_read(self, [self.states.index(a) for a in self.accumulators])

    @property
    def held_for(self) -> tuple[int, ...]:
        """The numbers of steps, above one, for which drifting parameters are held."""
        return held_for(self.drifting)

    @property
    def n_theta(self) -> int:
        """Length of the flat parameter vector."""
        return sum(map(size_of, self.parameter_shapes))

    @cached_property
    def fingerprint(self) -> str:
        """A digest of the equations and settings, the same in every process."""
        return digest(describe(self.with_known(()).with_instant_steps(False)))


def _checked_resets(resets: Any) -> str:
    if resets not in (None, "seen", "row"):
        raise ModelError(f"resets must be 'seen' or 'row', got {resets!r}")
    return resets or "seen"
