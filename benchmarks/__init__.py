"""Times of the filters and samplers beside loops by hand, C++ and other packages.

``python -m benchmarks`` (or ``make bench``) measures everything and writes the tables and figures
of ``docs/reference/benchmarks.md``; ``python -m benchmarks.quick`` takes a minute.
"""
