"""Filtered and smoothed states, forecasts and free runs, at draws of the posterior."""

from .estimation import filtered_states, smoothed_states
from .forecasting import forecast
from .free_runs import free_run

__all__ = ["filtered_states", "forecast", "free_run", "smoothed_states"]
