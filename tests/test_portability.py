"""Other systems: what Linux alone has is taken away, and the code is made for other processors.

Here are the quick ones; CONTRIBUTING.md says how to run any test without what Linux has.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.elsewhere import PLAIN

ROOT = Path(__file__).parents[1]
# A run with a checkpoint that is resumed, leases and journals, cores, and interrupts.
WITHOUT_LINUX = (
    "tests/runs_elsewhere.py",
    "tests/parallel/test_cpu_affinity.py",
    "tests/sampling/test_folder_lease.py",
    "tests/sampling/test_interrupts.py",
    "tests/sampling/test_checkpoint_file.py",
)
on_linux = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="nothing to take away")


@on_linux
def test_without_what_linux_has():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.elsewhere", "-p", "no:xdist"]
    # Slow and pure Python; and one whose child process has all of Linux.
    left_out = "-k", "not every_altered_byte and not truncated_segment and not a_living_process"
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", *left_out, *WITHOUT_LINUX],
        cwd=ROOT,
        env=os.environ | PLAIN,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
