"""What the evidence needs to know of the integration steps in a model."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters import EKF, Filter
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.pymc_model.inspection import likelihood_nodes
from pymc_statespace_filters.pymc_model.overshoot import smallest_multiplier
from pymc_statespace_filters.system.integrators import EulerMaruyama
from pymc_statespace_filters.system.model import StateSpaceModel

Array = NDArray[np.float64]


def densities_by_steps(model: pm.Model) -> tuple[TensorVariable, TensorVariable] | None:
    """A model's log-density by its Euler-Maruyama steps, and by steps half as long.

    Both by deterministic filters, the EKF where it can treat the system, else the variable's own.
    None if no variable has such steps, or if one has no deterministic filter.
    """
    log_density = model.logp()
    by_steps: list[dict[Variable, Variable]] = [{}, {}]
    nodes = likelihood_nodes([log_density])
    if not any(_has_steps(node) for node in nodes):
        return None
    for node in nodes:
        system = refined = node.op.system
        if _has_steps(node):
            integrator = system.integrator
            refined = system.with_integrator(replace(integrator, substeps=2 * integrator.substeps))
        filter = _deterministic_filter(system, refined, node.op.filter)
        if filter is None:
            return None
        for replaced, of in zip(by_steps, (system, refined), strict=True):
            outputs = LogLikelihood(of, filter)(*node.inputs)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
    coarse, fine = (clone_replace(log_density, replaced) for replaced in by_steps)
    return coarse, fine


def step_multipliers(model: pm.Model) -> Callable[[Array], Array] | None:
    """By which the steps of a model's integrators multiply a small deviation, at worst.

    The function takes points of the joined value variables (m, k) and gives numbers (m,), see
    `overshoot.smallest_multiplier`; the smallest of all variables with Euler-Maruyama steps. None
    if there are no such variables.
    """
    nodes = [node for node in likelihood_nodes([model.logp()]) if _has_steps(node)]
    if not nodes:
        return None
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    asked = [node.inputs[i] for node in nodes for i in (0, 1, 3, 4)]  # without data and seed
    outputs, joined = join_nonshared_inputs(model.initial_point(), asked, values)
    record = compile_pymc([joined], outputs, mode="FAST_COMPILE")

    def multipliers(x: Array) -> Array:
        columns = [np.stack(column) for column in zip(*map(record, x), strict=True)]
        found = [
            smallest_multiplier(node.op.system, *columns[4 * i : 4 * i + 4])
            for i, node in enumerate(nodes)
        ]
        return np.stack(found).min(axis=0)

    return multipliers


def _has_steps(node: Any) -> bool:
    return isinstance(node.op.system.integrator, EulerMaruyama)


def _deterministic_filter(
    system: StateSpaceModel, refined: StateSpaceModel, own: Filter
) -> Filter | None:
    """A filter that gives a number for both systems, whatever the seed."""
    for filter in (EKF(), own):
        try:
            filter.check(compile_system(system))
            filter.check(compile_system(refined))
        except ModelError:
            continue
        if not filter.noisy:
            return filter
    return None
