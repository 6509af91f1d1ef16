"""States of a system along its record and beyond it, draw by draw of the posterior."""

from pymc_statespace_filters.states.estimation import filtered_states, smoothed_states
from pymc_statespace_filters.states.forecasting import forecast

__all__ = ["filtered_states", "forecast", "smoothed_states"]
