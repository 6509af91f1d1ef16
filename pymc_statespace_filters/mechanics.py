"""Parts of equations of motion, and the modes of a linearised system."""

from .evaluation.linear_modes import linear_modes
from .system.forces import cubic, freeplay, hysteresis, hysteresis_branch
from .system.second_order import second_order
from .system.term_library import polynomial_terms

__all__ = [
    "cubic",
    "freeplay",
    "hysteresis",
    "hysteresis_branch",
    "linear_modes",
    "polynomial_terms",
    "second_order",
]
