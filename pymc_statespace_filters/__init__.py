"""Bayesian model selection and parameter estimation for nonlinear dynamical systems, inside PyMC."""

__version__ = "0.1.0.dev0"
