"""Plots of results; each function returns an ``arviz_plots.PlotCollection``."""

from .average import plot_average
from .designs import plot_designs
from .drift import plot_drift
from .evidence import plot_evidence, plot_model_probabilities
from .field import plot_field
from .filter_health import plot_filter_health
from .forecast import plot_forecast
from .prequential import plot_prequential
from .prior_sensitivity import plot_prior_sensitivity
from .residuals import plot_residuals
from .states import plot_states
from .terms import plot_terms

__all__ = [
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
]
