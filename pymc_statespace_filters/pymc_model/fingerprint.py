"""Hashes of a model and of its data.

A model is identified by what its graphs compute, see `system.graph_digest`. Two builds of a model
agree, in one process or in two.
"""

import pymc as pm
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.traversal import graph_inputs
from pytensor.tensor.random.type import RandomType

from ..system.graph_digest import described, digest, graph_digest
from .inspection import log_density_graph

FINGERPRINT_DIGITS = 16  # 64 bits, in a checkpoint and in messages


def model_fingerprint(model: pm.Model) -> str:
    """Hash everything that the draws of a model depend on, except for the numbers in its data.

    The hexadecimal SHA-256 is the same for every build of the model, in every process of the same
    versions of PyMC and PyTensor. It changes with any constant, prior, transform, potential,
    deterministic, name, dimension, coordinate and initial value, with the equations of a
    `StateSpace` and with the settings of its filter. Of observed values and other data it includes
    type and name: see `model_data_fingerprint`. Of a user-defined operation it includes the
    properties or attributes, not the Python code. Raises `ModelError` if an operation has an
    attribute without a text that is the same in every process, such as a Python function without a
    name; the message names both.
    """
    known = {value: digest("value of", rv.name) for rv, value in _roots(model).items()}
    names = {
        "free": [(rv.name, model.rvs_to_values[rv].name) for rv in model.free_RVs],
        "observed": [rv.name for rv in model.observed_RVs],
        "deterministics": [variable.name for variable in model.deterministics],
        "potentials": [variable.name for variable in model.potentials],
        "dims": dict(model.named_vars_to_dims),
        "coords": dict(model.coords),
        "starts": {rv.name: value for rv, value in model.rvs_to_initial_values.items()},
    }
    texts = [described(f"the model's {what}", value) for what, value in names.items()]
    return digest(*texts, graph_digest(_outputs(model), known))


def model_data_fingerprint(model: pm.Model) -> str:
    """Hash all numbers that a model was given as data, with their names.

    The hexadecimal SHA-256 of the names, types and bytes of observed values, of `pymc.Data`, and of
    every other shared variable that the model uses, including the noise seeds of its likelihoods.
    (The ``data_fingerprint`` of an evidence is another one: that of the observed values alone,
    which are the same in rival models, under any name.)
    """
    constants = {
        f"observed {rv.name}": value.data
        for rv, value in _roots(model).items()
        if isinstance(value, Constant)
    }
    used = [v for v in graph_inputs(_outputs(model)) if isinstance(v, SharedVariable)]
    shared = [
        (v.name, v.get_value(borrow=True) if isinstance(v, SharedVariable) else v.data)
        for v in dict.fromkeys([*model.data_vars, *used])
        # Generators are for draws outside the log-density, as in a posterior predictive.
        if not isinstance(v.type, RandomType)
    ]
    return digest(described("the model's data", [constants, shared]))


def _roots(model: pm.Model) -> dict[Variable, Variable]:
    """Values of random variables at which the graphs begin: of free ones, and constants."""
    return {
        rv: model.rvs_to_values[rv]
        for rv in model.basic_RVs
        if model.rvs_to_values[rv].owner is None
        and not isinstance(model.rvs_to_values[rv], SharedVariable)
    }


def _outputs(model: pm.Model) -> list[Variable]:
    return [log_density_graph(model), *model.unobserved_value_vars]
