"""Designs as models see them: rows, inputs and sensors of a record that is not yet measured."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..evaluation.exact_rows import check_rows
from ..evaluation.simulate import simulator
from ..system.given_record import GivenRecord
from ..system.input_columns import only_seen
from ..system.model import StateSpaceModel
from ..system.record import Record, read_record
from .rivals import ALONE, Rival

# The arguments of `StateSpace` that say when and what is measured.
TAKEN = ("steps", "times", "inputs", "input_times", "inputs_at", "t0", "unit", "events")

Array = NDArray[np.float64]


class Candidate(NamedTuple):
    """A design for one model: its system, steps (J,), inputs, t0, and the sensors (p,) it has."""

    system: StateSpaceModel
    steps: NDArray[np.int64]
    inputs: Array
    t0: float
    sensors: NDArray[np.bool_]

    def simulated(self, theta: Array, rng: np.random.Generator) -> Array:
        """A record (J, p), NaN for sensors that the design has not.

        It is observed at every step, so that designs with other steps have the same noise.
        """
        every = np.arange(self.steps[-1] + 1)
        _, found = simulator(self.system, True).function(rng, theta, every, self.inputs, self.t0)
        return np.where(self.sensors, found[self.steps], np.nan)


def read_designs(designs: Any, rivals: Mapping[str, Rival]) -> dict[str, list[Candidate]]:
    """Each design for all models.

    Raises `ModelError` if a model cannot take a design, or models would measure at different times.
    """
    if not isinstance(designs, Mapping) or not designs:
        raise ModelError(f"designs must be a dict of designs by name, got {designs!r}")
    return {name: _of_models(name, design, rivals) for name, design in designs.items()}


def _of_models(name: str, design: Any, rivals: Mapping[str, Rival]) -> list[Candidate]:
    if not isinstance(design, Mapping):
        raise ModelError(f"designs[{name!r}] must be a dict of arguments, got {design!r}")
    if unknown := [key for key in design if key not in (*TAKEN, "sensors")]:
        raise ModelError(
            f"designs[{name!r}] may have {', '.join(TAKEN)} and sensors, got {unknown}"
        )
    found, times = [], {}
    for model, rival in rivals.items():
        try:
            record, sensors = _read(design, rival)
        except ModelError as error:
            place = "" if list(rivals) == [ALONE] else f" for models[{model!r}]"
            raise ModelError(f"designs[{name!r}]{place}: {error}") from None
        steps, _, inputs, t0 = record.arguments
        found.append(Candidate(record.system, steps, inputs, float(t0), sensors))
        times[model] = record.times([axis.steps for axis in record.axes])
    first = next(iter(times.values()))
    for model, own in times.items():
        if not np.array_equal(own, first) and not _are_close(own, first):
            raise ModelError(
                f"designs[{name!r}] must measure all models at the same times, got {own[-1]} as "
                f"the last one of models[{model!r}] and {first[-1]} before: give times= in place "
                "of steps="
            )
    return found


def _are_close(times: np.ndarray, others: np.ndarray) -> bool:
    return times.shape == others.shape and times.dtype.kind == "f" and np.allclose(times, others)


def _read(design: Mapping[str, Any], rival: Rival) -> tuple[Record, NDArray[np.bool_]]:
    system = rival.system
    given = GivenRecord(**{key: design[key] for key in TAKEN if key in design})
    sensors = _sensors(design.get("sensors"), system.observables)
    record = read_record(system, given)
    seen = np.where(np.tile(sensors, (len(record.steps), 1)), 0.0, np.nan)
    record = record._replace(
        observed=seen, inputs=only_seen(record.system, record.inputs, record.steps, seen)
    )
    check_rows(record, rival.filter)
    return record, sensors


def _sensors(given: Any, observables: Sequence[str]) -> NDArray[np.bool_]:
    """Which observables are measured; None is all."""
    if given is None:
        return np.ones(len(observables), dtype=bool)
    is_list = isinstance(given, list | tuple) and given
    if not is_list or any(one not in observables for one in given):
        raise ModelError(
            f"sensors must be a list of some of the observables {list(observables)}, got {given!r}"
        )
    return np.isin(observables, list(given))
