"""Kernel densities of weighted particles, exact and gridded."""
