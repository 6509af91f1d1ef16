"""A system as filters see it: its sizes, its properties, and its compiled functions."""

from functools import cached_property, lru_cache

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from ..codegen.function_types import Graph, MemberFunction, ParameterFunction
from ..codegen.functions import member_function
from ..native.entry_point import EntryPoint
from . import quantiles, structure
from .constants import covariances, extend, followed_by_square_roots, lowered, pull_back
from .directions import Directions, directions_of
from .guidance import guided_noise, linearize_step, n_gains, observation_information
from .guide_loops import follow, look_back
from .jumps import jumping_equations, jumping_parameters, stepped_parameters
from .observation import expected_observation, observation_log_density
from .symbols import call, symbols_of, uses

quantiles.register()


@lru_cache(maxsize=256)
def compile_system(model: StateSpaceModel) -> "CompiledSystem":
    """The compiled form of a system, made once for equal systems."""
    return CompiledSystem(model)


class CompiledSystem:
    """Sizes, properties and compiled functions of one system, each made on its first use.

    Members of an ensemble are the columns of ``X`` (n, N). ``c = prepare(theta)`` are the constants
    of one evaluation: the parameters, the initial mean, then the lower square roots of the
    covariances, NaN where one is not positive semidefinite. ``Z`` holds standard normals and may
    have more columns than there are members; ``k`` is the step, ``t`` its time, ``inputs`` has a
    row for each step.

    * ``prepare(theta)`` returns c.
    * ``initialise(c, Z, X)`` draws the state at step 0.
    * ``propagate(c, inputs, k, t, Z, X)`` moves every member from step k to k + 1, in place.
    * ``observe(c, inputs, k, t, Z, X, D)`` simulates observations D (p, N), where the user wrote an
      observation function.
    * ``expect(c, inputs, k, t, X, D)`` writes observations D (p, N) without noise.
    * ``log_density(c, inputs, k, t, d, X, out)`` writes log p(d | x), NaN components left out.
    * ``propagate_guided(c, inputs, k, t, gains, Z, X)`` moves every member by noise that depends on
      its state, see `guided_noise`; X has one row more, to which log density ratios are added.
    * ``linearized_step(c, inputs, k, t, noise, X, out)`` writes the next state of every column of X
      with this noise and its Jacobians, see `linearize_step`.
    * ``observation_information(c, inputs, k, t, d, X, out)`` writes log p(d | x), its score and its
      information, for one member.
    * ``step_moments(c, inputs, k, t, X, M)`` writes mean and variance of the next state given each
      column of X into M (2, N); for one state and additive noise.

    Each has an entry point, for machine code, and a ``function`` that Python calls with these
    arguments.

    ``model`` is what the user wrote, for filters that work on its graphs. Linear algebra of
    parameters alone is left out of them: its values are read from more parameters, see `extend`.
    ``n``, ``n_start``, ``m``, ``p``, ``r``, ``n_inputs``, ``n_theta`` and ``n_constants`` are the
    numbers of states, of normals that a member takes at the start and in one step (see
    `merged_noise`), of observables, of measurement noises, of columns of inputs, of parameters, and
    the length of ``c``, in which ``square_roots`` has the places of those of the covariances. The
    ``free`` states are those that an update may move: all but the carried ones.
    """

    def __init__(self, given: StateSpaceModel) -> None:
        # Numbers that a model fixes may decide which values a finite state has.
        is_finite = (given.equations.finite_step or given.equations.finite_start) is not None
        self._posed = given
        self.written = given.folded if is_finite else given.with_known(())
        found = lowered(self.written)
        self.model = model = found.model
        self._extension = found.extension
        self.n, self.p, self.r = model.n, model.p, model.r
        self.n_inputs, self.n_theta, self.dt = model.n_input_columns, model.n_theta, model.dt
        self.states, self.carried = tuple(model.states), tuple(model.carried)
        self.gaussian_observation = bool(model.gaussian_observation)
        self.additive_noise = bool(model.additive_noise)
        self.observation_uses_inputs = bool(model.observation_uses_inputs)
        carried = [self.states.index(name) for name in self.carried]
        self.free = np.setdiff1d(np.arange(self.n), carried)
        draw = model.equations.initial_draw
        self.n_start = model.n if draw is None else draw.inputs[1].type.shape[0]
        self._merged_noise = structure.merged_noise(model)
        self.m = model.m if self._merged_noise is None else model.n
        self._covariances = covariances(model, self._merged_noise)
        sizes = {name: g.outputs[0].type.shape[0] for name, g in self._covariances.items()}
        self.n_constants = self.n_theta + self.n + sum(size**2 for size in sizes.values())
        self.constants = pt.tensor("c", shape=(self.n_constants,), dtype="float64")
        self._symbols = symbols_of(model) | {"theta": self.constants[: self.n_theta]}
        self.square_roots, self._square_roots = {}, {}
        start = self.n_theta + self.n
        for name, size in sizes.items():
            self.square_roots[name] = start
            self._square_roots[name] = self.constants[start : start + size**2].reshape((size, size))
            start += size**2

    # Constants of an evaluation

    @cached_property
    def extend(self) -> EntryPoint | None:
        """Theta -> (theta, constants), which the functions of ``model`` take; None if the same."""
        return None if self._extension is None else extend(self._extension).entry

    @cached_property
    def extend_back(self) -> EntryPoint | None:
        """Theta and the cotangent of (theta, constants), one vector, -> the cotangent of theta."""
        return None if self._extension is None else pull_back(self._extension).entry

    # Functions

    def entry_point(self, name: str) -> EntryPoint:
        """A function by its name, or a loop over steps that a guide makes; not compiled yet."""
        if name == "follow":
            return follow(self)
        if name in ("look_back", "start_back"):
            return look_back(self.n, self.n if name == "start_back" else self.m)
        return getattr(self, name).entry

    @cached_property
    def prepare(self) -> ParameterFunction:
        """Theta -> c."""
        given = theta = pt.tensor("theta", shape=(self.written.n_theta,), dtype="float64")
        if self._extension is not None:
            (theta,) = self._extension.bind([given])
        mean = call(self.model.equations.initial_mean, self.model, {"theta": theta})
        outputs = [theta, mean]
        return followed_by_square_roots(outputs, self.model, given, theta, self._covariances)

    @cached_property
    def initialise(self) -> MemberFunction:
        """Draw the state at step 0."""
        z, mean = _normals(self.n_start), self.constants[self.n_theta : self.n_theta + self.n]
        draw = self.model.equations.initial_draw
        if draw is None:
            # Drifting parameters, the last states, have a known start.
            k = self.n - len(self.model.drifting)
            root = self._square_roots["initial_cov"]
            state = pt.concatenate([mean[:k] + root[:k, :k] @ z[:k], mean[k:]])
        else:
            (state,) = draw.bind([self._symbols["theta"], z])
        return self._member_function("initialise", "c, Z, X", state, "X", z=z)

    @cached_property
    def propagate(self) -> MemberFunction:
        """Move every member one step, in place."""
        z = _normals(self.m)
        arguments = "c, inputs, k, t, Z, X"
        step = self._step(self._symbols["x"], z)
        return self._member_function("propagate", arguments, step, "X", "xut", z=z)

    @cached_property
    def propagate_guided(self) -> MemberFunction:
        """Move every member one step by guided noise, in place, and weigh its move."""
        n, m, z = self.n, self.m, _normals(self.m)
        member = pt.tensor("x", shape=(n + 1,), dtype="float64")
        gains = pt.tensor("gains", shape=(n_gains(n, m),), dtype="float64")
        noise, log_ratio = guided_noise(gains, member[:n], z)
        moved = pt.concatenate([self._step(member[:n], noise), [member[n] + log_ratio]])
        inputs = {"theta": self.constants, "u": self._symbols["u"], "t": self._symbols["t"]}
        graph = Graph(inputs | {"x": member, "z": z, "gains": gains}, [moved])
        arguments = "c, inputs, k, t, gains, Z, X"
        return member_function("propagate_guided", arguments, graph, "X")

    @cached_property
    def linearized_step(self) -> MemberFunction:
        """The next state and its Jacobians, at points with the same noise."""
        x, noise = self._symbols["x"], pt.tensor("noise", shape=(self.m,), dtype="float64")
        linearized = linearize_step(self._step(x, noise), x, noise, self.free)
        inputs = {"theta": self.constants, **{i: self._symbols[i] for i in "xut"}, "noise": noise}
        arguments = "c, inputs, k, t, noise, X, out"
        graph = Graph(inputs, [linearized])
        return member_function("linearized_step", arguments, graph, "out")

    @cached_property
    def observation_information(self) -> MemberFunction:
        """log p(d | x), its score and its information, at one state."""
        information = observation_information(self.model, self._given("xutd"), self.free)
        inputs = {"theta": self.constants, **{i: self._symbols[i] for i in "xutd"}}
        arguments, graph = "c, inputs, k, t, d, X, out", Graph(inputs, [information])
        return member_function("observation_information", arguments, graph, "out", vector=False)

    @cached_property
    def observe(self) -> MemberFunction:
        """Simulate an observation of every member."""
        z = _normals(self.r)
        noise = {"e": self._sensor_noise(z)}
        seen = call(self.model.equations.observation, self.model, self._given("xut") | noise)
        arguments = "c, inputs, k, t, Z, X, D"
        return self._member_function("observe", arguments, seen, "out", "xut", z=z)

    @cached_property
    def expect(self) -> MemberFunction:
        """The observation of every member without noise."""
        seen = expected_observation(self.model, self._given("xut"))
        arguments = "c, inputs, k, t, X, D"
        return self._member_function("expect", arguments, seen, "out", "xut")

    @cached_property
    def log_density(self) -> MemberFunction:
        """log p(d | x) of every member."""
        density = pt.atleast_1d(observation_log_density(self.model, self._given("xutd")))
        arguments = "c, inputs, k, t, d, X, out"
        return self._member_function("log_density", arguments, density, "out", "xutd")

    @cached_property
    def step_moments(self) -> MemberFunction:
        """Mean and variance of the next state, for one state and additive noise."""
        arguments = "c, inputs, k, t, X, M"
        moments = structure.step_moments(self.model, self._given("xut"))
        return self._member_function("step_moments", arguments, moments, "out", "xut")

    def _step(self, x: TensorVariable, z: TensorVariable) -> TensorVariable:
        """The next state, from standard normals."""
        noise, transition = self._coloured("process_noise", z), self.model.equations.transition
        given = self._given("ut") | {"x": x}
        if self._merged_noise is None:
            return call(transition, self.model, given | {"q": noise})
        return call(transition, self.model, given) + noise

    def _given(self, names: str) -> dict[str, TensorVariable]:
        return {name: self._symbols[name] for name in ("theta", *names)}

    def _coloured(self, name: str, z: TensorVariable) -> TensorVariable:
        """Noise of this covariance; an integrator's noise is white."""
        return self._square_roots[name] @ z if name in self._square_roots else z

    def _sensor_noise(self, z: TensorVariable) -> TensorVariable:
        """Noise of an observation, whose covariance may depend on inputs and time."""
        covariance = self.model.equations.observation_noise
        if covariance is None or not uses(covariance, "ut"):
            return self._coloured("observation_noise", z)
        return cholesky(call(covariance, self.model, self._given("ut")), lower=True) @ z

    def _member_function(
        self, name: str, arguments: str, output: TensorVariable, target: str, inputs: str = "", **z
    ) -> MemberFunction:
        graph_inputs = {"theta": self.constants, **{i: self._symbols[i] for i in inputs}, **z}
        return member_function(name, arguments, Graph(graph_inputs, [output]), target)

    # Properties

    @cached_property
    def asked(self) -> StateSpaceModel:
        """The ``model`` with the numbers that are known, of which all properties are asked."""
        return lowered(self._posed.folded).model

    @cached_property
    def is_deterministic(self) -> bool:
        """Whether the state is a function of the parameters: no noise, and a known start."""
        return structure.is_deterministic(self.asked)

    @cached_property
    def undriven_states(self) -> tuple[str, ...]:
        """The names of the states with an uncertain start that noise is known never to reach."""
        return tuple(self.states[i] for i in structure.undriven_states(self.asked))

    @cached_property
    def with_gaussian_steps(self) -> "CompiledSystem":
        """The system with normal variables in place of others in ``process_dist``."""
        return compile_system(self._posed.with_gaussian_steps)

    @cached_property
    def gaussian(self) -> "CompiledSystem":
        """The same with a Gaussian start."""
        return compile_system(self._posed.gaussian)

    @cached_property
    def is_linear(self) -> bool:
        """Whether state and noise enter transition and observation linearly; False if unknown."""
        return structure.is_linear(self.asked)

    @cached_property
    def has_additive_process_noise(self) -> bool:
        """Whether g(x, q) = g(x, 0) + G(x) q; False if unknown."""
        return structure.has_additive_process_noise(self.asked)

    @cached_property
    def has_smooth_transition(self) -> bool:
        """Whether no part of the transition has a kink or a jump; False if unknown."""
        return structure.has_smooth_transition(self.asked)

    @cached_property
    def is_smooth(self) -> bool:
        """Whether no equation has a kink or jump in states or parameters; False if unknown."""
        return structure.is_smooth(self.asked)

    @cached_property
    def jumping_equations(self) -> tuple[str, ...]:
        """Those of "transition" and "observation" that are known to jump in the state."""
        return jumping_equations(self.asked)

    @cached_property
    def jumping_parameters(self) -> tuple[str, ...]:
        """Drifting parameters at whose threshold an equation is known to jump."""
        return jumping_parameters(self.asked)

    @cached_property
    def stepped_parameters(self) -> tuple[str, ...]:
        """Parameters of which every likelihood is known to be a staircase."""
        return stepped_parameters(self.asked)

    @property
    def has_gaussian_sensor(self) -> bool:
        """Whether an observation is a function with Gaussian noise, of which parts may be censored.

        If none is, its density is Gaussian, which is ``gaussian_observation``.
        """
        return self.model.equations.observation_logp is None

    @cached_property
    def has_independent_sensors(self) -> bool:
        """Whether the observables are independent given the state; False if unknown."""
        return structure.has_independent_sensors(self.asked)

    @cached_property
    def has_smooth_sensor(self) -> bool:
        """Whether no observable has a kink as a function of the state."""
        return structure.has_smooth_sensor(self.asked)

    @cached_property
    def has_linear_sensor(self) -> bool:
        """Whether an observation with noise is linear in state and noise; False if unknown."""
        return structure.has_linear_observation(self.asked)

    @cached_property
    def has_exact_sensor(self) -> bool:
        """Whether a sensor has no noise; False if unknown."""
        return structure.has_exact_sensor(self.asked)

    @cached_property
    def directions(self) -> Directions:
        """How many numbers are random at the start and in a step, and which sensors are exact."""
        return directions_of(self.asked)

    @cached_property
    def start_over_noise(self) -> float:
        """How many times its noise the variance of an observation of the start is, if known."""
        return structure.start_over_noise(self.asked)

    @cached_property
    def is_time_invariant(self) -> bool:
        """Whether `step_moments` depends on neither inputs nor time; False if unknown."""
        symbols = {name: symbols_of(self.asked)[name] for name in ("theta", *"xut")}
        moments = structure.step_moments(self.asked, symbols)
        return structure.is_free_of(("u", "t"), moments, symbols)

    @cached_property
    def has_transition_density(self) -> bool:
        """Whether every step has a Gaussian density given the state before."""
        if self.model.held_for:  # a parameter that is held has no noise
            return False
        additive = self.has_additive_process_noise
        return additive and structure.process_noise_reaches_every_state(self.asked)

    @property
    def has_exact_observation_density(self) -> bool:
        """Whether `log_density` is exact; noise that is not additive enters by linearization."""
        return self.additive_noise or not self.gaussian_observation


def _normals(size: int) -> TensorVariable:
    return pt.tensor("z", shape=(size,), dtype="float64")
