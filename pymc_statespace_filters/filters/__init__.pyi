from .bootstrap import BootstrapPF
from .ekf import EKF
from .enkf import EnKF
from .ensemble.base import EnsembleFilterBase
from .ensemble.callbacks import FORECAST
from .ensemble.evaluation import members_of, show, time_of
from .ensemble.loop import Outcome, Plain, failed, member_filter, updated
from .ensemble.part_moments import read_moments, write_moments
from .ensemble.particle_filter import ParticleFilter
from .ensemble.parts import PartsFilter
from .ensemble.reductions import weighted_mean
from .finite_state import FiniteStateFilter
from .grid import GridFilter
from .guided_pf import GuidedPF
from .imm import IMM
from .iplf import IPLF
from .outcomes import COVARIANCE_NOT_POSITIVE
from .own import linalg, njit_internal
from .pf_enkf import PFEnKF
from .plan import initialise, log_density, propagate, simulate
from .protocol import (
    DifferentiableFilter,
    EnsembleFilter,
    Filter,
    PredictionFilter,
    System,
    ToleranceFilter,
)
from .rbpf import RBPF
from .ukf import UKF

__all__ = [
    "COVARIANCE_NOT_POSITIVE",
    "EKF",
    "FORECAST",
    "IMM",
    "IPLF",
    "RBPF",
    "UKF",
    "BootstrapPF",
    "DifferentiableFilter",
    "EnKF",
    "EnsembleFilter",
    "EnsembleFilterBase",
    "Filter",
    "FiniteStateFilter",
    "GridFilter",
    "GuidedPF",
    "Outcome",
    "PFEnKF",
    "ParticleFilter",
    "PartsFilter",
    "Plain",
    "PredictionFilter",
    "System",
    "ToleranceFilter",
    "failed",
    "initialise",
    "linalg",
    "log_density",
    "member_filter",
    "members_of",
    "njit_internal",
    "propagate",
    "read_moments",
    "show",
    "simulate",
    "time_of",
    "updated",
    "weighted_mean",
    "write_moments",
]
