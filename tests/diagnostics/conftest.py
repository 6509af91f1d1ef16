"""How the tests of diagnostics evaluate PyTensor's graphs."""

import pytensor
import pytest


@pytest.fixture(scope="module", autouse=True)
def interpreted():
    """In Python, around the machine code of the filters, which takes no part in PyTensor's mode.

    Every diagnosis has graphs of its own, and machine code of one takes seconds to compile.
    """
    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        yield
