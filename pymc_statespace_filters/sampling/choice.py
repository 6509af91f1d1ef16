"""Which samplers a model allows: the random walk of `sample_dram`, or NUTS too."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import pytensor
from pymc.model import Model
from pytensor.gradient import DisconnectedInputError

from ..pymc_model.inspection import gradient_obstacle, kinked_variable, log_density_graph
from ..pymc_model.stepped import stepped_variables

DRAM, NUTS, BOTH = "dram", "nuts", "both"
# Iterations of each chain at most, in draws, unless the user says so.
MOST_THIN = {DRAM: 1024, NUTS: 64, BOTH: 1024}


class Choice(NamedTuple):
    """A sampler, or both, and why."""

    sampler: str
    reason: str


def what_nuts_lacks(arguments: Mapping[str, Any]) -> str:
    """The first of these arguments that is given, which the random walk alone has, as a reason."""
    given = [name for name, value in arguments.items() if value is not None]
    return f"NUTS has no {given[0]}" if given else ""


def why_dram(model: Model) -> str:
    """What keeps NUTS from a model, as far as its filters show it; empty if nothing does."""
    if reason := gradient_obstacle(model):
        return reason
    if kinked := kinked_variable(model):
        return f"the equations of {kinked!r} have kinks or jumps"
    return ""


def why_not_after_all(model: Model) -> str:
    """The rest of it, which takes a while to find out."""
    if steps := stepped_variables(model):
        return f"the likelihood is a staircase of {steps[0]}"
    return _missing_gradient(model)


def why_no_nuts(model: Model) -> str:
    """What makes it impossible that NUTS samples a model; empty if nothing does."""
    return gradient_obstacle(model) or _missing_gradient(model)


def _missing_gradient(model: Model) -> str:
    try:
        pytensor.grad(log_density_graph(model), [model.rvs_to_values[rv] for rv in model.free_RVs])
    except DisconnectedInputError:
        return "the density has no gradient with respect to some parameter"
    except (NotImplementedError, TypeError, ValueError):
        return "an operation in the model has no gradient"
    return ""
