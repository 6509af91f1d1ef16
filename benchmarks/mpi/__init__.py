"""Run time against the number of ranks: one likelihood, and a whole study.

``python -m benchmarks.mpi`` (or ``make bench-mpi``) measures on one and two ranks, models more, and
writes the tables of ``docs/reference/mpi_scaling.md``.
"""
