"""The log-likelihood of a record as PyTensor operations: its value, and its derivative."""

from pymc_statespace_filters.ops.batch import BatchLogLikelihood, has_batch, vectorized
from pymc_statespace_filters.ops.delegated import (
    DelegableLogLikelihood,
    DelegableLogLikelihoodOfNoise,
    Delegate,
)
from pymc_statespace_filters.ops.gradient import LogLikelihoodGradient
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.record import (
    HEALTH_SIZE,
    RecordOp,
    cache_key,
    check_record,
    evaluator,
)
from pymc_statespace_filters.ops.run import FilterRun
from pymc_statespace_filters.ops.shared import SharedLogLikelihood
from pymc_statespace_filters.ops.states import States
from pymc_statespace_filters.ops.stored_noise import LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.ops.tape import TapedLogLikelihood, TapeReversal

__all__ = [
    "HEALTH_SIZE",
    "BatchLogLikelihood",
    "DelegableLogLikelihood",
    "DelegableLogLikelihoodOfNoise",
    "Delegate",
    "FilterRun",
    "LogLikelihood",
    "LogLikelihoodGradient",
    "LogLikelihoodOfNoise",
    "RecordOp",
    "SharedLogLikelihood",
    "States",
    "StoredNoise",
    "TapeReversal",
    "TapedLogLikelihood",
    "cache_key",
    "check_record",
    "evaluator",
    "has_batch",
    "vectorized",
]
