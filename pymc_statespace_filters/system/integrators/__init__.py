"""Integrators: one step of the state from a stochastic or ordinary differential equation.

Each is one file with its equation, its order and where it is stable. `protocol` holds the contract.
"""

from .euler_maruyama import EulerMaruyama
from .exact_linear import ExactLinear
from .local_linearization import LocalLinearization
from .milstein import Milstein
from .protocol import Integrator
from .runge_kutta import RungeKutta4
from .semi_implicit_euler import SemiImplicitEuler

__all__ = [
    "EulerMaruyama",
    "ExactLinear",
    "Integrator",
    "LocalLinearization",
    "Milstein",
    "RungeKutta4",
    "SemiImplicitEuler",
]
