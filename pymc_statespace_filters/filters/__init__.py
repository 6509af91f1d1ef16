"""The filters, and what your own filter needs: the contract in `protocol`, and base classes.

`EnsembleFilterBase` and `ParticleFilter` with `ensemble_filter` and `particle_filter` give a filter
with members everything but its update; a filter of another kind satisfies `Filter` by itself.
"""

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.filters.bootstrap import BootstrapPF
from pymc_statespace_filters.filters.ekf import EKF
from pymc_statespace_filters.filters.enkf import EnKF
from pymc_statespace_filters.filters.ensemble.base import EnsembleFilterBase
from pymc_statespace_filters.filters.ensemble.loop import Outcome, ensemble_filter, failed
from pymc_statespace_filters.filters.ensemble.particle_filter import ParticleFilter, particle_filter
from pymc_statespace_filters.filters.grid import GridFilter
from pymc_statespace_filters.filters.guided_pf import GuidedPF
from pymc_statespace_filters.filters.iplf import IPLF
from pymc_statespace_filters.filters.pf_enkf import PFEnKF
from pymc_statespace_filters.filters.protocol import (
    BatchFilter,
    DifferentiableFilter,
    EnsembleFilter,
    Filter,
    HealthFilter,
    PredictionFilter,
    RunFilter,
    StatesFilter,
    System,
)
from pymc_statespace_filters.filters.ukf import UKF

__all__ = [
    "EKF",
    "IPLF",
    "UKF",
    "BatchFilter",
    "BootstrapPF",
    "CompiledFunction",
    "DifferentiableFilter",
    "EnKF",
    "EnsembleFilter",
    "EnsembleFilterBase",
    "Filter",
    "GridFilter",
    "GuidedPF",
    "HealthFilter",
    "Outcome",
    "PFEnKF",
    "ParticleFilter",
    "PredictionFilter",
    "RunFilter",
    "StatesFilter",
    "System",
    "ensemble_filter",
    "failed",
    "particle_filter",
]
