"""The laws of noise: what replaces a random variable in a graph, by its kind."""

import pytensor.tensor.random.basic as ptr
from pytensor.graph.basic import Apply
from pytensor.tensor.variable import TensorVariable

from .scalar import SCALAR_LAWS, ScalarLaw
from .vector import CategoricalLaw, MultinomialLaw, MvNormalLaw

type Law = ScalarLaw | CategoricalLaw | MultinomialLaw | MvNormalLaw

LAWS: dict[type, Law] = {
    **SCALAR_LAWS,
    ptr.CategoricalRV: CategoricalLaw(),
    ptr.MultinomialRV: MultinomialLaw(),
    ptr.MvNormalRV: MvNormalLaw(),
}

_PYMC_NAMES = {
    "NegBinomial": "NegativeBinomial",
    "InvGamma": "InverseGamma",
    "WeibullBeta": "Weibull",
}


def law_name(kind: type) -> str:
    """The name of a distribution in PyMC."""
    name = kind.__name__.removesuffix("RV")
    return _PYMC_NAMES.get(name, name)


def parameters_of(node: Apply) -> list[TensorVariable]:
    """The parameters of a random variable, which follow its generator and its size."""
    return node.inputs[2:]
