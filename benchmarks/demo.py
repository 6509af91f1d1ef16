"""CPU seconds of ``make demo`` and ``make demo-quick``: with an empty cache, and again."""

import os
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass

from benchmarks.measure import ROOT

COMMANDS = {"make demo": [], "make demo-quick": ["--quick"]}


@dataclass(frozen=True)
class Demo:
    """CPU seconds of the first run of an installation, and of the second."""

    command: str
    first: float
    second: float


def seconds(options: list[str], cache: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = os.path.join(cache, "out")
    script = ["examples/double_well.py", "--no-progressbar", "--out", out]
    subprocess.run(
        [sys.executable, "-W", "ignore", *script, *options],
        cwd=ROOT,
        env=os.environ | {"PYTENSOR_FLAGS": f"base_compiledir={cache}", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def demo() -> list[Demo]:
    rows = []
    for command, options in COMMANDS.items():
        with tempfile.TemporaryDirectory() as cache:
            rows.append(Demo(command, seconds(options, cache), seconds(options, cache)))
    return rows
