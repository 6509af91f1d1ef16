"""What generated source may name, for one number and for the members of an ensemble.

A loop that calls the system's library is no vector code, so loops over members have functions of
their own. Where one number follows the other the library's tables are the quicker way.
"""

import operator

import numpy as np

from pymc_statespace_filters.compiler.numerics import (
    exponential as exponentials,
)
from pymc_statespace_filters.compiler.numerics import (
    hyperbolic,
)
from pymc_statespace_filters.compiler.numerics import (
    intrinsics as instructions,
)
from pymc_statespace_filters.compiler.numerics import (
    trigonometric as trigonometry,
)

_NUMPY = (
    "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sqrt", "sin", "cos", "tan", "arcsin",
    "arccos", "arctan", "arctan2", "sinh", "cosh", "tanh", "floor", "ceil", "trunc", "rint",
)  # fmt: skip

FOR_ONE = {
    "np": np, "inf": np.inf, "nan": np.nan, "power": operator.pow,
    "floor_divide": operator.floordiv, "modulo": operator.mod,
    **{name: getattr(np, name) for name in _NUMPY},
}  # fmt: skip

_FOR_VECTORS = (
    exponentials.exp, exponentials.exp2, exponentials.expm1, exponentials.log, exponentials.log2,
    exponentials.log10, exponentials.log1p, exponentials.power, hyperbolic.sinh,
    hyperbolic.cosh, hyperbolic.tanh, trigonometry.sin, trigonometry.cos, trigonometry.tan,
    trigonometry.arctan, trigonometry.arctan2, trigonometry.floor_divide, trigonometry.modulo,
)  # fmt: skip

FOR_MEMBERS = (
    FOR_ONE
    | {"sqrt": instructions.sqrt}
    | {function.py_func.__name__: function for function in _FOR_VECTORS}
)
