from .diagnostics import (
    check_filter,
    compute_log_likelihood,
    filter_diagnostics,
    leave_future_out,
)
from .errors import (
    CheckpointError,
    CheckpointWarning,
    DataMismatchError,
    EvidenceWarning,
    FilterWarning,
    GradientUnavailableError,
    LoweringError,
    ModelError,
    ParallelError,
    ParallelWarning,
    StateSpaceFiltersError,
)
from .evaluation.linear_modes import linear_modes
from .evaluation.log_likelihood import log_likelihood
from .evaluation.run_filter import run_filter
from .evaluation.simulate import simulate
from .evidence import (
    DimensionCorrection,
    Evidence,
    average_models,
    chib_jeliazkov,
    compare_evidence,
    estimate_evidence,
    marginal_modes,
    prior_sensitivity,
    reweight,
    step_error,
)
from .filters import EKF, IPLF, UKF, BootstrapPF, EnKF, GridFilter, GuidedPF, PFEnKF
from .plots import (
    plot_average,
    plot_evidence,
    plot_filter_health,
    plot_forecast,
    plot_model_probabilities,
    plot_phase,
    plot_prior_sensitivity,
    plot_residuals,
    plot_states,
)
from .point_estimation import MaximumLikelihoodEstimate, maximum_likelihood
from .pymc_model.distribution import StateSpace
from .sampling import DRAM, find_starts, run_models, sample_dram, suggest_particles
from .states import filtered_states, forecast, free_run, smoothed_states
from .system.forces import cubic, freeplay, hysteresis, hysteresis_branch
from .system.integrators import (
    EulerMaruyama,
    ExactLinear,
    LocalLinearization,
    Milstein,
    RungeKutta4,
    SemiImplicitEuler,
)
from .system.model import StateSpaceModel
from .system.noise_distributions import euler_multinomial, gamma_white_noise
from .system.panel_frame import panel_from
from .system.second_order import second_order
from .system.steps import nearest_steps

__version__: str

__all__ = [
    "DRAM",
    "EKF",
    "IPLF",
    "UKF",
    "BootstrapPF",
    "CheckpointError",
    "CheckpointWarning",
    "DataMismatchError",
    "DimensionCorrection",
    "EnKF",
    "EulerMaruyama",
    "Evidence",
    "EvidenceWarning",
    "ExactLinear",
    "FilterWarning",
    "GradientUnavailableError",
    "GridFilter",
    "GuidedPF",
    "LocalLinearization",
    "LoweringError",
    "MaximumLikelihoodEstimate",
    "Milstein",
    "ModelError",
    "PFEnKF",
    "ParallelError",
    "ParallelWarning",
    "RungeKutta4",
    "SemiImplicitEuler",
    "StateSpace",
    "StateSpaceFiltersError",
    "StateSpaceModel",
    "average_models",
    "check_filter",
    "chib_jeliazkov",
    "compare_evidence",
    "compute_log_likelihood",
    "cubic",
    "estimate_evidence",
    "euler_multinomial",
    "filter_diagnostics",
    "filtered_states",
    "find_starts",
    "forecast",
    "free_run",
    "freeplay",
    "gamma_white_noise",
    "hysteresis",
    "hysteresis_branch",
    "leave_future_out",
    "linear_modes",
    "log_likelihood",
    "marginal_modes",
    "maximum_likelihood",
    "nearest_steps",
    "panel_from",
    "plot_average",
    "plot_evidence",
    "plot_filter_health",
    "plot_forecast",
    "plot_model_probabilities",
    "plot_phase",
    "plot_prior_sensitivity",
    "plot_residuals",
    "plot_states",
    "prior_sensitivity",
    "reweight",
    "run_filter",
    "run_models",
    "sample_dram",
    "second_order",
    "simulate",
    "smoothed_states",
    "step_error",
    "suggest_particles",
]
