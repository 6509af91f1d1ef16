"""A model of records to come: its StateSpace variables need data for PyMC, which nothing reads."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pymc as pm

from ..errors import ModelError
from ..pymc_model.inspection import state_space_nodes


def with_dummy_data(model: pm.Model) -> pm.Model:
    """The model with data for StateSpace variables that have none: numbers that nothing reads.

    Raises `ModelError` if there is no StateSpace variable, or one with censored data.
    """
    nodes = state_space_nodes(model)
    if not nodes:
        names = [rv.name for rv in model.basic_RVs]
        raise ModelError(f"model must have a StateSpace variable, got the variables {names}")
    if censored := [name for name, node in nodes.items() if node.op.system.is_censored]:
        raise ModelError(
            f"model must have no censored data, got those of {censored}: which values of a record "
            "to come are censored is not known; build the model without censored="
        )
    shapes: dict[str, Any] = {}
    for name, node in nodes.items():
        if node.outputs[1] in model.free_RVs:
            shapes[name] = node.outputs[1].shape.eval(mode="FAST_COMPILE")
    if shapes:
        order = [rv.name for rv in model.free_RVs]
        with _without_initial_values(model):
            model = pm.observe(model, {name: np.zeros(shape) for name, shape in shapes.items()})
        # The copy has them in an order that differs from process to process.
        model.free_RVs.sort(key=lambda rv: order.index(rv.name))
    return model


@contextmanager
def _without_initial_values(model: pm.Model) -> Iterator[None]:
    """PyMC copies no model that has some; draws of priors and posteriors need none."""
    given = dict(model.rvs_to_initial_values)
    model.rvs_to_initial_values.update(dict.fromkeys(given))
    try:
        yield
    finally:
        model.rvs_to_initial_values.update(given)
