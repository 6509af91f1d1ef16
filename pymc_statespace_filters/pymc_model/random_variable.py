"""The random variable operation behind `StateSpace`.

The module `dispatch` registers how the operation is drawn and what its log-density is; this one
imports no simulator, so that a module can test for the operation's type at little cost.
"""

from collections.abc import Sequence
from copy import copy
from functools import singledispatch
from typing import Any, Self

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable

from ..filters.protocol import Filter
from ..system.clock import Clock
from ..system.events import Events
from ..system.input_columns import only_seen
from ..system.model import StateSpaceModel
from ..system.timed_inputs import TimedInputs

NUMBERS = Clock()


class StateSpaceRV(RandomVariable):
    """Draws data (J, p) from theta, steps, inputs and t0; its last input, the seed, is unused.

    The log-density leaves out the terms of the first ``score_from`` rows. ``clock`` turns model
    times into those of the user, for results; ``timed`` are the inputs of each record as the user
    gave them, if with times of their own, and ``events`` its events, for forecasts.
    """

    name = "StateSpace"
    signature = "(k),(j),(s,u),(),()->(j,p)"
    dtype = "float64"
    __props__ = (
        *RandomVariable.__props__,
        "system",
        "filter",
        "score_from",
        "clock",
        "timed",
        "events",
    )
    _print_name = ("StateSpace", "\\operatorname{StateSpace}")

    def __init__(
        self,
        *,
        system: StateSpaceModel,
        filter: Filter,
        score_from: int = 0,
        clock: Clock = NUMBERS,
        timed: tuple[TimedInputs, ...] = (),
        events: tuple[Events, ...] = (),
        **settings: Any,
    ) -> None:
        self.system = system
        self.filter = filter
        self.score_from = score_from
        self.clock = clock
        self.timed = timed
        self.events = events
        super().__init__(**settings)

    def __str__(self) -> str:
        return f"StateSpaceRV{{{self.filter}}}"

    def with_filter(self, filter: Filter) -> Self:
        """The same operation with another filter."""
        other = copy(self)
        other.filter = filter
        return other

    def _supp_shape_from_params(self, dist_params: Sequence, param_shapes: Any = None) -> list:
        # Steps (J,), or the rows (J, 3) of a panel: the other dimensions before are of a batch.
        steps = dist_params[1].shape if param_shapes is None else param_shapes[1]
        return [steps[-self.ndims_params[1]], self.system.p]

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> np.ndarray:
        """Draw in PyTensor's modes without numba."""
        return draw_in_python(self, rng, *arguments)


class PanelRV(StateSpaceRV):
    """Draws the rows (J, p) of a panel from theta (G, k), rows (J, 3), inputs and t0.

    The log-density leaves out the terms of the first ``score_from`` rows of every record.
    """

    signature = "(g,k),(j,c),(s,u),(),()->(j,p)"


@singledispatch
def draw_in_python(op: RandomVariable, rng: np.random.Generator, *arguments: Any) -> np.ndarray:
    """Draw data with a NumPy generator; arguments are the parameters and the batch shape."""
    raise NotImplementedError(f"no draw is registered for {op}")


def inputs_as_seen(op: StateSpaceRV, inputs: Variable, steps: Variable, value: Variable) -> Any:
    """The inputs of the variable where its data are ``value``, also if it was made without them."""
    is_data = isinstance(value, Constant | SharedVariable) and value not in ancestors([inputs])
    if not is_data or inputs.type.ndim != 2:
        return inputs
    return pt.as_tensor(only_seen(op.system, inputs, steps, value))


def make_seed(name: str, seed: np.ndarray) -> SharedVariable:
    """The noise seed of a variable, as shared data of its model.

    As pm.Data makes it, which would truncate the seed to 32 bits.
    """
    return pytensor.shared(seed, name=f"{name}_seed")
