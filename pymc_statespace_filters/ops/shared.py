"""The log-likelihood of a record by a filter whose members belong to several ranks."""

from collections.abc import Mapping
from typing import ClassVar

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.ops.base import RECORD_INPUTS
from pymc_statespace_filters.ops.likelihood import LogLikelihood


class DistributedLogLikelihood(LogLikelihood):
    """`LogLikelihood` of a noisy filter, called by all ranks at once; the same numbers on each.

    Three inputs more: ``rank``, ``n_ranks``, and the address of their ``exchange``.
    """

    input_types = (
        *RECORD_INPUTS,
        ("rank", "int64", 0),
        ("n_ranks", "int64", 0),
        ("exchange", "int64", 0),
    )
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str]] = {}

    def compile(self) -> CompiledFunction:
        """The filter's machine code for one rank's share."""
        return self.filter.compile_shared(self.system)  # type: ignore[union-attr]
