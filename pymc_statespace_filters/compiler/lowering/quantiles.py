"""Operations with machine code of the package in graphs that PyTensor compiles itself, to numba."""

from typing import Any

from pytensor.link.numba.dispatch.basic import register_funcify_and_cache_key

from ...system.normal_below import NormalBelow
from ...system.quantiles import NoDerivative, Quantile
from ..codegen.emitter import QUANTILES
from ..native.cache_key import key_of
from ..native.jit import njit_callable


def register() -> None:
    """Tell PyTensor's numba backend what the operations are in machine code."""
    register_funcify_and_cache_key(Quantile)(_machine_code)
    register_funcify_and_cache_key(NormalBelow)(_machine_code)
    register_funcify_and_cache_key(NoDerivative)(_refuse)


def _machine_code(op: Quantile | NormalBelow, node: Any = None, **_: Any) -> tuple:
    function = QUANTILES[op.machine_code]

    @njit_callable
    def quantile(*arguments):
        return function(*arguments)

    return quantile, key_of(__name__, op.machine_code)


def _refuse(op: NoDerivative, node: Any = None, **_: Any) -> tuple:
    raise NotImplementedError(f"{op}, which jumps. Use a filter without derivatives: BootstrapPF")
