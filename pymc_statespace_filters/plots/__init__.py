"""Plots of results; each function returns an ``arviz_plots.PlotCollection``."""

from pymc_statespace_filters.plots.average import plot_average
from pymc_statespace_filters.plots.evidence import plot_evidence
from pymc_statespace_filters.plots.filter_health import plot_filter_health
from pymc_statespace_filters.plots.forecast import plot_forecast
from pymc_statespace_filters.plots.model_probabilities import plot_model_probabilities
from pymc_statespace_filters.plots.phase import plot_phase
from pymc_statespace_filters.plots.prior_sensitivity import plot_prior_sensitivity
from pymc_statespace_filters.plots.residuals import plot_residuals
from pymc_statespace_filters.plots.states import plot_states

__all__ = [
    "plot_average",
    "plot_evidence",
    "plot_filter_health",
    "plot_forecast",
    "plot_model_probabilities",
    "plot_phase",
    "plot_prior_sensitivity",
    "plot_residuals",
    "plot_states",
]
