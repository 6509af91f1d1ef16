"""One record of a state-space variable at draws of the posterior: its parameters and states."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compiler.native.python_call import call_machine_code
from ..compiler.numerics.philox import seed_of_record
from ..errors import ModelError
from ..evaluation.simulate import observer
from ..pymc_model.state_space_variable import (
    StateSpaceVariable,
    states_of,
    term_health_of,
)
from ..system.input_columns import (
    columns_of_steps,
    flags_at,
    inputs_of_user,
    n_rows_of_user,
    with_columns,
)
from ..system.model import StateSpaceModel
from ..system.time_axis import TimeAxis

if TYPE_CHECKING:
    from .variable import VariableAtDraws

Array = NDArray[np.float64]


class States(NamedTuple):
    """Mean, sd and a draw of the state (draws, R, n), and effective sample size (draws, R).

    ``health`` (draws, 3) are the outcomes of the filter, with the noise of ``seeds`` (draws,).
    """

    seeds: NDArray[np.int64]
    mean: Array
    sd: Array
    drawn: Array
    n_effective: Array
    health: Array


class TermHealthAtDraws(NamedTuple):
    """Effective number behind every term (draws, J), and what `States` says of it."""

    seeds: NDArray[np.int64]
    n_effective: Array
    health: Array


@dataclass(frozen=True)
class RecordAtDraws:
    """The record ``number`` of a variable, with its steps (J,) and data (J, p).

    ``code`` is what its noise depends on beside the seed, and ``input_rows`` which of the
    variable's inputs it has; ``code`` and ``label`` are None for a variable without a panel.
    """

    at_draws: "VariableAtDraws"
    number: int
    code: int | None
    label: Any
    steps: NDArray[np.int64]
    observed: Array
    t0: float
    input_rows: slice = slice(None)

    @property
    def variable(self) -> StateSpaceVariable:
        """The variable, whose graphs are those of all its records."""
        return self.at_draws.variable

    @property
    def scored(self) -> Array:
        """The data (J, p), missing in the rows without a term in the log-density."""
        scored = self.observed.copy()
        scored[: self.variable.score_from] = np.nan
        return scored

    @property
    def flags(self) -> Array:
        """On which side of the data (J, p) true values lie: -1 below, 1 above, 0 where measured."""
        return flags_at(self.variable.system, self.inputs[0], self.steps)

    @property
    def measured(self) -> Array:
        """The data that are scored, NaN where they are censored."""
        return np.where(self.flags == 0.0, self.scored, np.nan)

    @property
    def theta(self) -> Array:
        """Flat parameters at every draw, (draws, k)."""
        return self.at_draws.theta[:, self.number]

    @property
    def inputs(self) -> Array:
        """Input rows at every draw, (draws or 1, rows, n_input_columns)."""
        return self.at_draws.inputs[:, self.input_rows]

    @property
    def axis(self) -> TimeAxis:
        """The steps of the record in time."""
        system = self.variable.system
        of_steps = columns_of_steps(system, self.inputs[0])
        if not system.is_at_any_times:
            return TimeAxis(self.steps, self.t0, system.dt, columns=of_steps)
        columns = self.inputs[0, : self.steps[-1] + 1, system.n_inputs :]
        lengths, starts = columns[:, 0].copy(), columns[:, 1].copy()
        lengths[-1] = 0.0
        return TimeAxis(self.steps, self.t0, system.dt, starts, lengths, of_steps)

    def shown(self, times: Any) -> Any:
        """The user's times."""
        return self.variable.clock.shown(times, self.number)

    def inputs_until(self, axis: TimeAxis) -> Array:
        """The inputs for the observations of an axis; checked to have the rows they need."""
        system = self.variable.system
        rows = inputs_of_user(system, self.inputs)
        if len(rows[0]) < (needed := n_rows_of_user(system, axis.steps)) and system.n_inputs:
            raise ModelError(
                f"{self.prefix}the model's inputs end after {len(rows[0])} rows, and step "
                f"{axis.steps[-1]} needs {needed}: give inputs= for the "
                "steps after the data alone, or for all from step 0 on (of the model's inputs with "
                "times, from the first time on with input_times=)"
            )
        if axis.starts is None:
            return with_columns(system, rows, axis)
        return with_columns(system.at_any_times, rows[:, : axis.starts.size], axis)

    @property
    def prefix(self) -> str:
        """What a message about this record begins with."""
        return "" if self.code is None else f"record {self.label!r}: "

    def states(self, moment: str, rows: NDArray[np.int64], rng: np.random.Generator) -> States:
        """States at steps `rows`, with the noise of each draw's likelihood estimate.

        Fresh noise is used where no seed is stored.
        """
        seeds, draw_seeds = self._seeds(rng), self._fresh_seeds(rng)
        drawn = {"seed": seeds, "draw_seed": draw_seeds}
        found = self.evaluate(states_of(self.variable, moment), drawn, {"wanted": rows})
        return States(seeds, *found)

    def term_health(self, rng: np.random.Generator) -> TermHealthAtDraws:
        """How many members are behind every term, with the noise of each draw's estimate."""
        seeds = self._seeds(rng)
        found = self.evaluate(term_health_of(self.variable), {"seed": seeds})
        return TermHealthAtDraws(seeds, *found)

    def evaluate(
        self,
        evaluation: Callable[..., list[Array]],
        drawn: Mapping[str, np.ndarray],
        constant: Mapping[str, np.ndarray] | None = None,
        draws: slice = slice(None),
    ) -> list[Array]:
        """The results of an evaluation of the record, each at every one of the ``draws``.

        Its arguments beside parameters and record are ``drawn``, which differ from draw to draw, or
        ``constant``.
        """
        varying = {"theta": self.theta, **drawn}
        fixed = {"steps": self.steps, "observed": self.observed, "t0": np.asarray(self.t0)}
        fixed |= constant or {}
        if len(self.inputs) > 1:
            varying["inputs"] = self.inputs
        else:
            fixed["inputs"] = self.inputs[0]
        varying = {name: values[draws] for name, values in varying.items()}
        return evaluation(varying, fixed, self.at_draws.on_progress)

    def arguments(self, i: int, seed: np.int64) -> tuple[Any, ...]:
        """All inputs of a likelihood at a draw, with the noise of ``seed``."""
        inputs = self.inputs[i if len(self.inputs) > 1 else 0]
        return self.theta[i], self.steps, self.observed, inputs, self.t0, seed

    def noise_of(self, seeds: NDArray[np.int64]) -> NDArray[np.int64]:
        """The seeds of the record's noise, given those of the variable's (draws,) or (draws, G)."""
        if self.code is None:
            return seeds
        of_variable = seeds[:, self.number] if seeds.ndim == 2 else seeds
        return np.array([seed_of_record(seed, self.code) for seed in of_variable], dtype=np.int64)

    def _seeds(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """The seed of each draw's estimate; a fresh one where none is stored or read."""
        stored = self.at_draws.stored_seeds
        return self._fresh_seeds(rng) if stored is None else self.noise_of(stored)

    def _fresh_seeds(self, rng: np.random.Generator) -> NDArray[np.int64]:
        return rng.integers(np.iinfo(np.int64).max, size=self.at_draws.n_draws)


def simulate_observations(
    record: RecordAtDraws,
    system: StateSpaceModel,
    states: Array,
    steps: NDArray[np.int64],
    rows: Array,
    rng: np.random.Generator,
) -> Array:
    """Simulate an observation (draws, R, p) of each state (draws, R, n); NaN where that is NaN.

    ``system`` is the record's, or that at any times, whose inputs are ``rows``.
    """
    observe = observer(system).function
    simulated = np.full((*states.shape[:2], system.p), np.nan)
    for i, path in enumerate(states):
        known = np.isfinite(path).all(axis=1)
        inputs = rows[i if len(rows) > 1 else 0]
        simulated[i, known] = call_machine_code(
            observe, rng, record.theta[i : i + 1], path[known], steps[known], inputs, record.t0
        )
    return simulated
