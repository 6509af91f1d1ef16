"""Constants of an evaluation that array code computes."""

import numpy as np
import pytensor.tensor as pt

from pymc_statespace_filters.compiler.codegen.function_types import jit
from pymc_statespace_filters.compiler.lowering.staged import staged


def test_array_code_takes_its_arguments_alone():
    theta = pt.tensor("theta", shape=(3,), dtype="float64")
    extended = pt.specify_shape(pt.concatenate([theta, pt.cumsum(theta)]), (6,))
    evaluate = staged("extend", [theta], extended).function
    found = jit(lambda values: evaluate(values))(np.array([3.0, 1.0, 2.0]))
    np.testing.assert_array_equal(found, [3.0, 1.0, 2.0, 3.0, 4.0, 6.0])
