"""From traced equations to machine code; the only room that knows how PyTensor works inside."""

from pymc_statespace_filters.lowering.compile import vector_functions
from pymc_statespace_filters.lowering.compiled import (
    Compiled,
    Graph,
    VectorFunction,
    jit,
)
from pymc_statespace_filters.lowering.draws import observation_sampler
from pymc_statespace_filters.lowering.ensemble import (
    Machine,
    covariance_check,
    ensemble_machine,
    semidefinite_cholesky,
)
from pymc_statespace_filters.lowering.gaussian import log_normal, without_missing
from pymc_statespace_filters.lowering.graphs import (
    call,
    jacobian_of,
    observation_moments,
    symbols_of,
)
from pymc_statespace_filters.lowering.lanes import LANES, LANES_AT_ONCE, lane_functions
from pymc_statespace_filters.lowering.members import (
    MachineEntries,
    OneStateEntries,
    machine_entries,
    one_state_entries,
)
from pymc_statespace_filters.lowering.noise import is_linear, process_noise_reaches_every_state
from pymc_statespace_filters.lowering.one_state import (
    OneState,
    has_additive_process_noise,
    has_smooth_transition,
    one_state,
)
from pymc_statespace_filters.lowering.unroll import NotUnrollableError

__all__ = [
    "LANES",
    "LANES_AT_ONCE",
    "Compiled",
    "Graph",
    "Machine",
    "MachineEntries",
    "NotUnrollableError",
    "OneState",
    "OneStateEntries",
    "VectorFunction",
    "call",
    "covariance_check",
    "ensemble_machine",
    "has_additive_process_noise",
    "has_smooth_transition",
    "is_linear",
    "jacobian_of",
    "jit",
    "lane_functions",
    "log_normal",
    "machine_entries",
    "observation_moments",
    "observation_sampler",
    "one_state",
    "one_state_entries",
    "process_noise_reaches_every_state",
    "semidefinite_cholesky",
    "symbols_of",
    "vector_functions",
    "without_missing",
]
