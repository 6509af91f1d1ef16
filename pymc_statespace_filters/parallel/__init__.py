"""MPI communicators, processor cores and signals."""
