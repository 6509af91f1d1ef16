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
    return digest_of_sources(Path(__file__).parents[2])


def digest_of_sources(package: Path) -> str:
    """The digest of all sources that machine code can be made by, in nested folders too.

    Machine code on disk must not outlive the code that it was made by. A file's place counts, for
    machine code is loaded by way of the module that it was made in.
    """
    files = [*package.glob("*.py")]
    for folder in ("system", "compiler", "filters", "ops"):
        files += package.joinpath(folder).rglob("*.py")
    sources = [
        part
        for file in sorted(files)
        for part in (file.relative_to(package).as_posix().encode(), file.read_bytes())
    ]
    return hashlib.sha256(b"\0".join(sources)).hexdigest()
