from . import compartments, errors, mechanics, pharmacometrics
from .designs import expected_information, identifiability
from .diagnostics import (
    check_filter,
    compute_log_likelihood,
    filter_diagnostics,
    leave_future_out,
)
from .evaluation.log_likelihood import log_likelihood
from .evaluation.online import online
from .evaluation.run_filter import run_filter
from .evaluation.simulate import simulate
from .evidence import (
    average_models,
    chib_jeliazkov,
    compare_evidence,
    drift_evidence,
    estimate_evidence,
    prior_sensitivity,
    reweight,
    step_error,
)
from .filters import (
    EKF,
    IMM,
    IPLF,
    RBPF,
    UKF,
    BootstrapPF,
    EnKF,
    FiniteStateFilter,
    GridFilter,
    GuidedPF,
    PFEnKF,
)
from .parameter_particles import extend, sample_smc
from .plots import (
    plot_average,
    plot_designs,
    plot_drift,
    plot_evidence,
    plot_field,
    plot_filter_health,
    plot_forecast,
    plot_model_probabilities,
    plot_prequential,
    plot_prior_sensitivity,
    plot_residuals,
    plot_states,
    plot_terms,
)
from .point_estimation import maximum_likelihood
from .pymc_model.distribution import StateSpace
from .sampling import (
    DRAM,
    find_starts,
    sample,
    sample_dram,
    suggest_particles,
)
from .several_models import run_models
from .states import field, filtered_states, forecast, free_run, smoothed_states
from .system.drift_processes import OrnsteinUhlenbeck, RandomWalk
from .system.drifting import drifting
from .system.integrators import (
    EulerMaruyama,
    ExactLinear,
    LocalLinearization,
    Milstein,
    RungeKutta4,
    SemiImplicitEuler,
)
from .system.model import StateSpaceModel
from .system.panel_frame import panel_from
from .system.steps import nearest_steps
from .terms import select_terms

__version__: str

__all__ = [
    "DRAM",
    "EKF",
    "IMM",
    "IPLF",
    "RBPF",
    "UKF",
    "BootstrapPF",
    "EnKF",
    "EulerMaruyama",
    "ExactLinear",
    "FiniteStateFilter",
    "GridFilter",
    "GuidedPF",
    "LocalLinearization",
    "Milstein",
    "OrnsteinUhlenbeck",
    "PFEnKF",
    "RandomWalk",
    "RungeKutta4",
    "SemiImplicitEuler",
    "StateSpace",
    "StateSpaceModel",
    "average_models",
    "check_filter",
    "chib_jeliazkov",
    "compare_evidence",
    "compartments",
    "compute_log_likelihood",
    "drift_evidence",
    "drifting",
    "errors",
    "estimate_evidence",
    "expected_information",
    "extend",
    "field",
    "filter_diagnostics",
    "filtered_states",
    "find_starts",
    "forecast",
    "free_run",
    "identifiability",
    "leave_future_out",
    "log_likelihood",
    "maximum_likelihood",
    "mechanics",
    "nearest_steps",
    "online",
    "panel_from",
    "pharmacometrics",
    "plot_average",
    "plot_designs",
    "plot_drift",
    "plot_evidence",
    "plot_field",
    "plot_filter_health",
    "plot_forecast",
    "plot_model_probabilities",
    "plot_prequential",
    "plot_prior_sensitivity",
    "plot_residuals",
    "plot_states",
    "plot_terms",
    "prior_sensitivity",
    "reweight",
    "run_filter",
    "run_models",
    "sample",
    "sample_dram",
    "sample_smc",
    "select_terms",
    "simulate",
    "smoothed_states",
    "step_error",
    "suggest_particles",
]
