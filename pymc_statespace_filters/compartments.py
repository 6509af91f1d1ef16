"""Distributions of the process noise of compartment models, for `process_dist`."""

from .system.noise_distributions import euler_multinomial, gamma_white_noise

__all__ = ["euler_multinomial", "gamma_white_noise"]
