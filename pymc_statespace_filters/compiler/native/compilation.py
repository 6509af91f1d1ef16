"""The lock of compilation by PyTensor.

PyTensor changes its global flags while it compiles, and sets them back afterwards. Of two threads
that compile at once, one sets back what the other has changed: the mode of the process is then one
without numba, for good.
"""

from threading import RLock

COMPILATION = RLock()
"""Held by sampling and evidence, except while chains run, and where `log_likelihood` compiles."""
