"""Integrators: one step of the state from a stochastic or ordinary differential equation.

Each is one file with its equation, its order and where it is stable. `protocol` holds the contract.
"""

from pymc_statespace_filters.system.integrators.euler_maruyama import EulerMaruyama
from pymc_statespace_filters.system.integrators.exact_linear import ExactLinear
from pymc_statespace_filters.system.integrators.local_linearization import LocalLinearization
from pymc_statespace_filters.system.integrators.milstein import Milstein
from pymc_statespace_filters.system.integrators.protocol import Integrator
from pymc_statespace_filters.system.integrators.runge_kutta import RungeKutta4
from pymc_statespace_filters.system.integrators.semi_implicit_euler import SemiImplicitEuler

__all__ = [
    "EulerMaruyama",
    "ExactLinear",
    "Integrator",
    "LocalLinearization",
    "Milstein",
    "RungeKutta4",
    "SemiImplicitEuler",
]
