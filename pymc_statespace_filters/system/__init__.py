"""What a user writes, validated: equations, forces, integrators, data and parameters.

Exported for users: `stationary`, for the start of a Markov chain. For new integrators: the protocol
`Integrator`, `read_equation` for the user's functions, and `as_vector` and `as_matrix` for what
these return.
"""

from .equations import Equation, as_matrix, as_vector, read_equation
from .integrators import Integrator
from .stationary import stationary

__all__ = ["Equation", "Integrator", "as_matrix", "as_vector", "read_equation", "stationary"]
