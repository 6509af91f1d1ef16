"""What the bits of a result depend on besides the model: versions, and the processor."""

import platform
import warnings
from functools import cache
from importlib.metadata import version
from zlib import crc32

from numba.core.registry import cpu_target

from pymc_statespace_filters.errors import ParallelError, ParallelWarning

_PACKAGES = (
    "pymc-statespace-filters",
    "pymc",
    "pytensor",
    "numba",
    "llvmlite",
    "numpy",
    "scipy",
)
_PROCESSOR = "processor"
# Without the features of a newer processor; what they cost is less than a measurement shows.
_CURE = (
    " Ranks on different x86 processors run the same machine code if all are started with "
    "NUMBA_CPU_NAME=x86-64-v3 and an empty NUMBA_CPU_FEATURES in the environment."
)


@cache
def describe_environment() -> dict[str, str]:
    """What this process computes with, by name."""
    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    features = f"{crc32(features.encode()):08x}"  # some hundred names
    return {
        "Python": platform.python_version(),
        **{package: version(package) for package in _PACKAGES},
        "C library": " ".join(platform.libc_ver()).strip(),
        _PROCESSOR: f"{processor} (features {features})",
    }


def check_alike(reports: list[dict[str, str]], rank: int, *, in_lockstep: bool) -> None:
    """Whether all ranks compute with the same.

    Parameters
    ----------
    reports : list of dict
        The surroundings of every rank.
    rank : int
        That of this process.
    in_lockstep : bool
        Several ranks evaluate one likelihood: they must agree to the bit. Otherwise each runs
        chains of its own, which other bits do not make wrong.

    Raises
    ------
    ParallelError
        If they differ and go in lockstep.

    Warns
    -----
    ParallelWarning
        On rank 0, if they differ and do not.
    """
    found = "; ".join(_differences(reports))
    if not found:
        return
    found += "." + (_CURE if _PROCESSOR in found else "")
    if in_lockstep:
        raise ParallelError(f"Ranks that share a likelihood must be alike, but differ: {found}")
    if rank == 0:
        warnings.warn(
            f"The ranks differ: {found} The draws of a chain then depend on which rank runs it: "
            "they are right, but not reproducible to the bit.",
            ParallelWarning,
            stacklevel=2,
        )


def _differences(reports: list[dict[str, str]]) -> list[str]:
    """Who has what, of all that is not the same everywhere."""
    differences = []
    for name in reports[0]:
        holders: dict[str, list[int]] = {}
        for rank, report in enumerate(reports):
            holders.setdefault(report[name], []).append(rank)
        if len(holders) > 1:
            held = (f"{value} on {_named(ranks)}" for value, ranks in holders.items())
            differences.append(f"{name} {', '.join(held)}")
    return differences


def _named(ranks: list[int]) -> str:
    return ("rank " if len(ranks) == 1 else "ranks ") + ", ".join(map(str, ranks))
