"""The forward algorithm: exact for systems whose whole state takes finitely many values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..compiler.lowering.finite_states import Declared, FiniteStates, finite_states
from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.plan import Plan
from ..errors import ModelError
from ..system.checks import is_integer
from .markov_chain.backward import BACKWARD
from .markov_chain.forward import FORWARD
from .markov_chain.functions import chain_functions, is_smooth_in_parameters, table_of_states
from .markov_chain.predictions import PREDICTIONS_OF_CHAIN
from .markov_chain.states import FILTERED, MOMENTS, STATES_OF_CHAIN
from .plan import make_plan
from .protocol import System, check_sensor_has_noise
from .state_law import StateLaw, law_of_values
from .taped import TapedFilter


@dataclass(frozen=True)
class FiniteStateFilter(TapedFilter):
    """Forward algorithm: the exact likelihood of a system whose states take finitely many values.

    For hidden Markov models, Markov-switching regressions and counts in a small population. Every
    state of the system must be a number at the start or be drawn from ``pm.Bernoulli``,
    ``pm.Categorical``, ``pm.DiscreteUniform`` or ``pm.Binomial``, and change through such variables
    alone; the filter finds the values. Transition probabilities may depend on the state, on inputs,
    time and parameters, and observations may have any density. The filter is deterministic and has
    a gradient.

    Parameters
    ----------
    values : mapping of str to int or sequence of float, optional
        Values of states by name, where the start does not lead to all of them; ``{"regime": 3}``
        are 0, 1 and 2. A step that leads to other values is refused.

    Raises
    ------
    ModelError
        If ``values`` are no values; if the system has another state, or more than 4096 joint
        values.

    Notes
    -----
    Time grows with the number of transitions, one for each joint value of the states and each value
    that the noise may take there. Probabilities that depend on parameters alone are computed once
    for an evaluation. A state whose probability is below 1e-300 of the likeliest one's is dropped.

    L. R. Rabiner, "A tutorial on hidden Markov models", Proceedings of the IEEE 77 (1989). The
    gradient is the reverse of the scaled recursion, so that transitions of probability zero do no
    harm.

    Examples
    --------
    >>> import pymc as pm
    >>> import pytensor.tensor as pt
    >>> import pymc_statespace_filters as psf
    >>> hidden_markov = psf.StateSpaceModel(
    ...     transition=lambda x, q: [q[0]],
    ...     process_dist=lambda x, up, down: [
    ...         pm.Bernoulli.dist(pt.switch(pt.eq(x[0], 0), up, 1 - down))
    ...     ],
    ...     observation=lambda x, level: [level * x[0]],
    ...     observation_noise=[[0.25]],
    ...     initial_dist=lambda up, down: [pm.Bernoulli.dist(up / (up + down))],
    ...     states=["regime"],
    ... )
    >>> terms = psf.log_likelihood(
    ...     hidden_markov,
    ...     psf.FiniteStateFilter(),
    ...     {"up": 0.3, "down": 0.2, "level": 1.0},
    ...     [0.2, 1.1, 0.9, -0.3],
    ...     steps=range(4),
    ... )
    >>> float(terms.sum().round(6))
    -3.988134
    """

    values: Mapping[str, int | Sequence[float]] | None = None
    declared: Declared = field(default=(), init=False, repr=False)

    finds_path: ClassVar[bool] = True

    def __post_init__(self) -> None:
        given = {} if self.values is None else self.values
        if not isinstance(given, Mapping):
            raise ModelError(f"values must be a mapping of states to values, got {given!r}")
        found = tuple((name, _checked(name, given[name])) for name in sorted(given))
        object.__setattr__(self, "declared", found)

    def __hash__(self) -> int:
        return hash(self.declared)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FiniteStateFilter) and self.declared == other.declared

    def check(self, system: System) -> None:
        """Raise unless all states of the system are finite."""
        equations = system.model.equations
        if equations.finite_step is None and equations.finite_start is None:
            raise ModelError(
                "FiniteStateFilter needs states that are drawn from finitely many values, such as "
                "pm.Bernoulli and pm.Categorical in process_dist or initial_dist, and none is"
            )
        found = self._finite_states(system)
        if found.continuous:
            (name, why), *_ = found.why_not.items()
            raise ModelError(
                "FiniteStateFilter treats systems whose states all take finitely many values, and "
                f"the state {name!r} {why}"
            )
        if found.unbounded:
            raise ModelError(
                "FiniteStateFilter needs numbers of trials that are numbers or functions of the "
                "state, at most 1000, and a pm.Binomial in process_dist has others"
            )
        check_sensor_has_noise(type(self).__name__, system)

    def _finite_states(self, system: System) -> FiniteStates:
        unknown = sorted({name for name, _ in self.declared} - set(system.states))
        if unknown:
            raise ModelError(
                f"values must name states of {list(system.states)}, got {unknown[0]!r}"
            )
        return finite_states(system.model, self.declared)

    def is_exact_for(self, system: System) -> bool:
        """Whether the likelihood is that of the system."""
        return system.has_exact_observation_density

    def is_smooth_for(self, system: System) -> bool:
        """Whether the likelihood has no kink or jump as a function of the parameters.

        Choices between values of the state are none. False if unknown.
        """
        return is_smooth_in_parameters(system.model)

    def plan_of_pass(
        self,
        system: System,
        *,
        of_many: bool = False,
        leaves_tape: bool = False,
        goes_back: bool = False,
    ) -> Plan:
        """Plan a pass along a record; one that leaves a tape and goes back is the gradient."""
        return self._plan(system, BACKWARD if goes_back else FORWARD, leaves_tape=leaves_tape)

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered", "smoothed" or "most probable" states."""
        return self._plan(system, STATES_OF_CHAIN, last_event=MOMENTS[moment])

    def plan_of_run(self, system: System) -> Plan:
        """Plan one run: its members are all states, and their weights the probabilities."""
        n_states = len(self._finite_states(system).joint)
        return self._plan(system, STATES_OF_CHAIN, n_members=n_states, last_event=FILTERED)

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        return law_of_values(states, table_of_states(self._finite_states(system), system.n))

    def plan_of_predictions(self, system: System) -> Plan:
        """Plan the law of every observation given those before it."""
        return self._plan(system, PREDICTIONS_OF_CHAIN, functions=("observe",))

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "forward-backward"

    def _plan(
        self,
        system: System,
        run: EntryPoint,
        *,
        functions: Sequence[str] = ("prepare",),
        **others: int,
    ) -> Plan:
        chain = chain_functions(system, self.declared)
        entries: dict[str, EntryPoint] = {}
        if run is BACKWARD:
            entries |= chain.derivatives
            if system.extend_back is not None:
                entries["extend_back"] = system.extend_back
        n_states = int(chain.settings[0])
        return make_plan(
            system, run, functions, chain.settings, **chain.entries, **entries,
            state_size=1 + n_states, **others,
        )  # fmt: skip


def _checked(name: Any, values: Any) -> tuple[float, ...]:
    """The values of a state, sorted."""
    if is_integer(values) and values > 0:
        return tuple(float(i) for i in range(values))
    try:
        found = np.unique(np.asarray(values, dtype="float64"))
    except (TypeError, ValueError):
        found = np.zeros(0)
    if np.ndim(values) != 1 or not found.size or not np.isfinite(found).all():
        raise ModelError(
            f"values: those of {name!r} must be how many there are, at least 1, or a sequence of "
            f"finite numbers, got {values!r}"
        )
    return tuple(found.tolist())
