"""Times of the filters and samplers compared with hand-written loops, C++ and other packages.

``python -m benchmarks`` (or ``make bench``) measures everything and writes the tables and figures
of ``docs/reference/benchmarks.md``; ``python -m benchmarks.quick`` takes a minute.
"""
