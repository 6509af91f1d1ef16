"""Parts of equations of motion."""

from .system.forces import cubic, freeplay, hysteresis, hysteresis_branch
from .system.gaussian_process_terms import gaussian_process_terms
from .system.second_order import second_order
from .system.term_library import polynomial_terms

__all__ = [
    "cubic",
    "freeplay",
    "gaussian_process_terms",
    "hysteresis",
    "hysteresis_branch",
    "polynomial_terms",
    "second_order",
]
