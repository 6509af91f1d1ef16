"""Which terms belong in the equation: probabilities of sub-models of one full model."""

from .select_terms import select_terms

__all__ = ["select_terms"]
