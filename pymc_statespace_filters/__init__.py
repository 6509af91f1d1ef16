"""Likelihoods, sampling and model choice for nonlinear state-space models in PyMC."""

from pymc_statespace_filters.distribution import StateSpace
from pymc_statespace_filters.filters import EKF, BootstrapPF, EnKF, PFEnKF
from pymc_statespace_filters.integrators import EulerMaruyama
from pymc_statespace_filters.likelihood import log_likelihood
from pymc_statespace_filters.model import StateSpaceModel
from pymc_statespace_filters.nonlinearities import cubic, freeplay, hysteresis
from pymc_statespace_filters.records import nearest_steps
from pymc_statespace_filters.simulation import simulate

__all__ = [
    "EKF",
    "BootstrapPF",
    "EnKF",
    "EulerMaruyama",
    "PFEnKF",
    "StateSpace",
    "StateSpaceModel",
    "cubic",
    "freeplay",
    "hysteresis",
    "log_likelihood",
    "nearest_steps",
    "simulate",
]
