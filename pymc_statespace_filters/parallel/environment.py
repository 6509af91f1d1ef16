"""Versions and processor of this process, on which the last bits of a result depend."""

import platform
from functools import cache
from importlib.metadata import version
from zlib import crc32

from numba.core.registry import cpu_target

from ..errors import ParallelError, ParallelWarning, warn

_PACKAGES = ("pymc-statespace-filters", "pymc", "pytensor", "numba", "llvmlite", "numpy", "scipy")
_PROCESSOR = "processor"
# Without the instructions of newer processors; no loss of speed was measured.
_ADVICE = (
    " Ranks on different x86 processors run the same machine code if all are started with "
    "NUMBA_CPU_NAME=x86-64-v3 and an empty NUMBA_CPU_FEATURES in the environment."
)


@cache
def describe_environment() -> dict[str, str]:
    """Versions of the software and kind of the processor, by name."""
    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    features = f"{crc32(features.encode()):08x}"  # some hundred names, as a checksum
    return {
        "Python": platform.python_version(),
        **{package: version(package) for package in _PACKAGES},
        "C library": " ".join(platform.libc_ver()).strip(),
        _PROCESSOR: f"{processor} (features {features})",
    }


def check_environments(reports: list[dict[str, str]], rank: int, *, in_lockstep: bool) -> None:
    """Check that all ranks have the same software and processor, by `describe_environment` of each.

    Ranks in lockstep evaluate one likelihood, so that their results must be bitwise equal.
    Otherwise each runs whole chains, which are correct in any environment. Raises `ParallelError`
    if they differ and are in lockstep; warns on rank 0 if they differ and are not.
    """
    found = "; ".join(_differences(reports))
    if not found:
        return
    found += "." + (_ADVICE if _PROCESSOR in found else "")
    if in_lockstep:
        raise ParallelError(
            f"ranks that evaluate one likelihood must have the same environment, got {found}"
        )
    if rank == 0:
        warn(
            f"The ranks differ: {found} The draws of a chain then depend on the rank that runs it: "
            "they are correct, but not bitwise reproducible.",
            ParallelWarning,
        )


def _differences(reports: list[dict[str, str]]) -> list[str]:
    """For each property that differs between ranks, its values and their ranks."""
    differences = []
    for name in reports[0]:
        by_value: dict[str, list[int]] = {}
        for rank, report in enumerate(reports):
            by_value.setdefault(report[name], []).append(rank)
        if len(by_value) > 1:
            values = (f"{value} on {_named(ranks)}" for value, ranks in by_value.items())
            differences.append(f"{name} {', '.join(values)}")
    return differences


def _named(ranks: list[int]) -> str:
    return ("rank " if len(ranks) == 1 else "ranks ") + ", ".join(map(str, ranks))
