from .bootstrap import BootstrapPF
from .ekf import EKF
from .enkf import EnKF
from .ensemble.base import EnsembleFilterBase
from .ensemble.loop import Outcome, failed, member_filter
from .ensemble.particle_filter import ParticleFilter
from .finite_state import FiniteStateFilter
from .grid import GridFilter
from .guided_pf import GuidedPF
from .imm import IMM
from .iplf import IPLF
from .pf_enkf import PFEnKF
from .protocol import (
    BatchFilter,
    CompiledFunction,
    DifferentiableFilter,
    EnsembleFilter,
    Filter,
    HealthFilter,
    PredictionFilter,
    RunFilter,
    StatesFilter,
    System,
    ToleranceFilter,
)
from .rbpf import RBPF
from .ukf import UKF

__all__ = [
    "EKF",
    "IMM",
    "IPLF",
    "RBPF",
    "UKF",
    "BatchFilter",
    "BootstrapPF",
    "CompiledFunction",
    "DifferentiableFilter",
    "EnKF",
    "EnsembleFilter",
    "EnsembleFilterBase",
    "Filter",
    "FiniteStateFilter",
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
    "ToleranceFilter",
    "failed",
    "member_filter",
]
