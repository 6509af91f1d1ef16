"""Which sampler suits a model: the random walk of `sample_dram`, or NUTS."""

import time
from typing import NamedTuple

import numpy as np
import pytensor
from pymc.model import Model

from ..pymc_model.density import ModelDensity
from ..pymc_model.inspection import gradient_obstacle, kinked_variable
from ..pymc_model.stepped import stepped_variables

DRAM, NUTS = "dram", "nuts"

# Effective draws that the costs are compared for. The rest are typical of narrow posteriors of 4 to
# 50 parameters, with wide scatter (`benchmarks/choice.py` measures both samplers); that of the walk
# is rather low, as a walk that is slow takes ten times as long as NUTS, and NUTS at most some three
# times as long as a walk:
_N_EFFECTIVE = 400
_WALK_EFFICIENCY = 0.2  # effective draws of a random walk per evaluation, times d^2
_NUTS_EFFICIENCY = 0.04  # effective draws of NUTS per gradient
_NUTS_STEPS = 12  # gradients of an iteration of its warm-up
_GRADIENT = 3.0  # cost of a gradient, in log-densities
_CALL = 25e-6  # CPU seconds of a step of NUTS beside the gradient
_COMPILATION = 1.2  # CPU seconds to compile a gradient
# Evaluations of a search for starts.
_STARTS = 8000
# Seconds of a measurement of the cost, and evaluations at most.
_TIMED_SECONDS, _MOST_TIMED = 0.01, 512


class Choice(NamedTuple):
    """A sampler, and why."""

    sampler: str
    reason: str


def choose_sampler(model: Model, chains: int, tune: int) -> Choice:
    """The sampler that takes less time, of those that suit the model."""
    if reason := gradient_obstacle(model):
        return Choice(DRAM, reason)
    if kinked := kinked_variable(model):
        return Choice(DRAM, f"the equations of {kinked!r} have kinks or jumps")
    dim = _initial_position(model).size
    cost = seconds_per_evaluation(model)
    seconds = {name: expected_seconds(name, dim, cost, chains, tune) for name in (DRAM, NUTS)}
    quicker = min(seconds, key=lambda name: seconds[name])
    if quicker == NUTS:
        if steps := stepped_variables(model):
            return Choice(DRAM, f"the likelihood is a staircase of {steps[0]}")
        if reason := _missing_gradient(model):
            return Choice(DRAM, reason)
    return Choice(
        quicker,
        f"{dim} parameter{'s' * (dim > 1)}, {1e3 * cost:.2g} ms for a log-density: about "
        f"{seconds[DRAM]:.2g} CPU s by DRAM and {seconds[NUTS]:.2g} by NUTS",
    )


def expected_seconds(sampler: str, dim: int, cost: float, chains: int, tune: int) -> float:
    """CPU seconds for `_N_EFFECTIVE` effective draws, if a log-density takes ``cost`` seconds."""
    if sampler == DRAM:
        efficiency = min(0.1, _WALK_EFFICIENCY / max(dim, 1) ** 2)
        return cost * (_STARTS + chains * tune + _N_EFFECTIVE / efficiency)
    gradients = chains * tune * _NUTS_STEPS + _N_EFFECTIVE / _NUTS_EFFICIENCY
    return _COMPILATION + cost * _STARTS + (_GRADIENT * cost + _CALL) * gradients


def why_no_nuts(model: Model) -> str:
    """What makes it impossible that NUTS samples a model; empty if nothing does."""
    return gradient_obstacle(model) or _missing_gradient(model)


def _missing_gradient(model: Model) -> str:
    try:
        pytensor.grad(model.logp(), [model.rvs_to_values[rv] for rv in model.free_RVs])
    except (NotImplementedError, TypeError, ValueError) as error:
        return f"the model has no gradient ({type(error).__name__})"
    return ""


def _initial_position(model: Model) -> np.ndarray:
    point = model.initial_point(random_seed=0)
    return np.concatenate([np.ravel(point[model.rvs_to_values[rv].name]) for rv in model.free_RVs])


def seconds_per_evaluation(model: Model) -> float:
    """CPU seconds that the log-density takes at the model's initial point."""
    density, x = ModelDensity(model), _initial_position(model)
    density.evaluate(x[None])  # loads the machine code
    n = 1
    while True:  # more points for a short one, so that what Python takes does not count
        began = time.process_time()
        density.evaluate(np.broadcast_to(x, (n, x.size)))
        seconds = time.process_time() - began
        if seconds > _TIMED_SECONDS or n >= _MOST_TIMED:
            return seconds / n
        n *= 8
