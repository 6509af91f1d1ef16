"""Filtered and smoothed states, and forecasts, at draws of the posterior."""

from pymc_statespace_filters.states.estimation import filtered_states, smoothed_states
from pymc_statespace_filters.states.forecasting import forecast

__all__ = ["filtered_states", "forecast", "smoothed_states"]
