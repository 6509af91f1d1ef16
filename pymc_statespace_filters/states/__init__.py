"""Filtered and smoothed states, forecasts and free runs, at draws of the posterior."""

from pymc_statespace_filters.states.estimation import filtered_states, smoothed_states
from pymc_statespace_filters.states.forecasting import forecast
from pymc_statespace_filters.states.free_runs import free_run

__all__ = ["filtered_states", "forecast", "free_run", "smoothed_states"]
