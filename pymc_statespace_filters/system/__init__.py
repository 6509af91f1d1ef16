"""What a user writes: equations, forces, integrators, data, parameters; validated here.

For integrators of one's own: the contract `Integrator`, `read_equation` for the functions of the
user, `as_vector` and `as_matrix` for what they return.
"""

from pymc_statespace_filters.system.equations import Equation, as_matrix, as_vector, read_equation
from pymc_statespace_filters.system.integrators import Integrator

__all__ = ["Equation", "Integrator", "as_matrix", "as_vector", "read_equation"]
