"""The log-likelihood of a noisy filter as a function of its normals instead of their seed.

Reading a normal is many times cheaper than drawing it. A sampler that holds the noise (common
random numbers), or moves it a little at a time, draws the normals once.
"""

from collections.abc import Mapping
from typing import ClassVar

import pytensor.tensor as pt

from ..compiler.lowering.compiled_system import CompiledSystem
from ..filters.protocol import Compiled, EnsembleFilter
from .base import RECORD_INPUTS, FilterOp
from .likelihood import LogLikelihood


class StoredNoise(FilterOp):
    """The normals that a noisy filter uses with a seed: ``steps`` (J,), ``seed`` -> a vector."""

    filter: EnsembleFilter
    input_types = (RECORD_INPUTS[1], RECORD_INPUTS[5])
    output_types = (pt.dvector,)
    result_names = ("normals",)
    record_checks = ()

    def compile(self, system: CompiledSystem) -> Compiled:
        """The normals, in the filter's layout."""
        return self.filter.stored_noise(system)


class LogLikelihoodOfNoise(LogLikelihood):
    """`LogLikelihood` with the vector of `StoredNoise` in place of the seed; the same numbers."""

    input_types = (*RECORD_INPUTS[:5], ("normals", "float64", 1))
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(z)->(j),(h)"
    # Not copied: they are many.
    argument_code: ClassVar[Mapping[str, str | None]] = {
        "normals": "(np.int64(0), np.ascontiguousarray(normals))"
    }
