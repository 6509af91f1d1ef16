"""Likelihoods, filter runs and simulation without PyMC."""
