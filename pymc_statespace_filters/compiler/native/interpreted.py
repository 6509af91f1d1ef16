"""Graphs as interpreted functions of many points, for few calls."""

from collections.abc import Callable, Sequence

import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import vectorize_graph
from pytensor.tensor.variable import TensorVariable


def interpreted_at_points(arguments: Sequence[TensorVariable], output: TensorVariable) -> Callable:
    """The function of arrays (m, ...), one for each argument, that gives the outputs (m, ...).

    Machine code would take longer to compile than it saves in some thousand calls.
    """
    batches = [pt.tensor(shape=(None, *a.type.shape), dtype="float64") for a in arguments]
    vectorised = vectorize_graph(output, dict(zip(arguments, batches, strict=True)))
    # A constant output, such as an initial mean given as numbers, has no batch axis yet.
    if vectorised.type.ndim == output.type.ndim:
        vectorised = vectorised + pt.zeros((batches[0].shape[0],) + (1,) * output.type.ndim)
    return pytensor.function(batches, vectorised, mode="FAST_COMPILE", on_unused_input="ignore")
