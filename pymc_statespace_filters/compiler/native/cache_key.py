"""Keys of compiled code on disk, and the fast-math flags of generated code."""

import hashlib
from functools import cache
from pathlib import Path

# No "nnan" or "ninf": filters detect failures by NaN and infinity. No "reassoc": with "nsz" it
# folds x - x to 0 for every x, and numba's isfinite, which uses x - x, would always be true.
FAST_MATH = {"contract", "nsz", "arcp"}


def digest(*parts: str) -> str:
    """The key of compiled code, from ``parts`` that identify it and the sources of this package."""
    return hashlib.sha256("\0".join((_source_digest(), *parts)).encode()).hexdigest()


def key_of(what: str, *keys: str | None) -> str | None:
    """The key of code that calls compiled parts; None if a part cannot be cached."""
    known = [key for key in keys if key is not None]
    return digest(what, *known) if len(known) == len(keys) else None


@cache
def _source_digest() -> str:
    return digest_of_sources(Path(__file__).parents[2])


def digest_of_sources(package: Path) -> str:
    """The digest of all sources that generate machine code, nested folders included.

    A change of any of them invalidates the machine code on disk. A file's path counts too, because
    machine code is loaded through the module that it was compiled in.
    """
    files = [*package.glob("*.py")]
    for folder in ("system", "compiler", "filters", "ops", "evaluation", "pymc_model"):
        files += package.joinpath(folder).rglob("*.py")
    sources = [
        part
        for file in sorted(files)
        for part in (file.relative_to(package).as_posix().encode(), file.read_bytes())
    ]
    return hashlib.sha256(b"\0".join(sources)).hexdigest()
