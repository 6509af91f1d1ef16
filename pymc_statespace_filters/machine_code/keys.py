"""Under which key compiled code is kept on disk, and the flags that all of it is compiled with."""

import hashlib
from functools import cache
from pathlib import Path

# NaN and infinity keep their meaning: failures are found by them. With reassociation allowed beside
# "nsz", x - x becomes 0 for every x, and numba's isfinite, which is made of it, is always true.
FAST_MATH = {"contract", "nsz", "arcp"}


def digest(*parts: str) -> str:
    """The key of compiled code that is made of ``parts`` by the code of this package."""
    return hashlib.sha256("\0".join((_source_digest(), *parts)).encode()).hexdigest()


def key_of(what: str, *keys: str | None) -> str | None:
    """The key of code made of ``what`` and compiled parts; None if a part cannot be cached."""
    known = [key for key in keys if key is not None]
    return digest(what, *known) if len(known) == len(keys) else None


@cache
def _source_digest() -> str:
    """Machine code on disk must not outlive the code that it was made by."""
    package = Path(__file__).parent.parent
    # All that a model's machine code can be made by.
    folders = (".", "machine_code", "lowering", "filters", "ops")
    files = sorted(f for folder in folders for f in package.glob(folder + "/*.py"))
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()
