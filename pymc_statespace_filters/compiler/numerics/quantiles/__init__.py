"""Quantile functions of a standard normal, as machine code."""
