"""Automatic relevance determination: optimised normal priors of the coefficients of terms."""

from .relevance import relevance

__all__ = ["relevance"]
