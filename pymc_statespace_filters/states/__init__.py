"""States, forecasts, free runs, and fields of states, at draws of the posterior."""

from .estimation import filtered_states, smoothed_states
from .fields import field
from .forecasting import forecast
from .free_runs import free_run

__all__ = ["field", "filtered_states", "forecast", "free_run", "smoothed_states"]
