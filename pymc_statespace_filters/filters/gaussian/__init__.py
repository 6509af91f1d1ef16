"""Linearisation, recursion, derivative, batch evaluation and smoother of Gaussian filters."""
