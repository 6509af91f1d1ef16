"""The log-likelihood of a record as PyTensor operations: its value, and its derivative."""

# Registers how the operations are converted to JAX, at the time when that is imported.
from . import jax_graphs as jax_graphs
