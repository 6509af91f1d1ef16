"""Compilation of a model's log-density."""

from collections.abc import Sequence
from typing import Any

from pymc.pytensorf import compile as compile_pymc
from pytensor.graph.basic import Variable

from pymc_statespace_filters.compiler.native.compilation import (
    COMPILATION,
    undamaged_files,
    warning_filter,
)


def compile_density(inputs: Sequence[Variable], outputs: Sequence[Variable], **options: Any) -> Any:
    """Compile a graph of many scalars by PyMC's compiler, under the lock of compilation.

    Where there is no C++ compiler, PyTensor fuses at most 32 operands, which is a limit of NumPy's
    functions and not of numba's, and warns of a larger set: a model of nine parameters has one.
    """
    with COMPILATION, undamaged_files(), warning_filter("ignore", "Loop fusion failed"):
        return compile_pymc(inputs, outputs, **options)
