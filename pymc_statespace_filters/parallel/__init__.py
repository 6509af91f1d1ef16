"""Processes and processors: MPI, communicators, cores, signals."""
