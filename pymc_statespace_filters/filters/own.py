"""What machine code of a user's own filter needs that no filter defines."""

from ..compiler.native.jit import njit_internal
from ..compiler.numerics import small_cholesky as linalg

__all__ = ["linalg", "njit_internal"]
