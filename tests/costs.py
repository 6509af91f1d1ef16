"""A pytest plugin: what each test file costs, and whether a run compiles more than it is known to.

Compilation is a third of the time of all tests, and nobody sees it grow. What a single file
compiles depends on what ran before it; the sum over all files hardly does. A run of some files, or
one that finds code on disk, compiles less.
"""

import gc
import json
import os
import sys
from pathlib import Path

import pytest

KNOWN = 3770  # functions that numba compiles in all tests, in two processes on an empty cache
MOST = 1.1 * KNOWN
MEMORY = Path("/proc/self/statm")  # of Linux alone


def free_pass_managers():
    """Have llvmlite free its pass managers: it keeps half a megabyte for every compiled function.

    In llvmlite 0.50 the empty `_dispose` of one base class hides that of the other.
    """
    from llvmlite.binding import ffi, newpassmanagers

    for manager in (newpassmanagers.ModulePassManager, newpassmanagers.FunctionPassManager):
        if manager._dispose is ffi.ObjectRef._dispose:
            manager._dispose = newpassmanagers.NewPassManager._dispose


def compiled_on_import():
    """Fail if the import of a test file has compiled: each process imports all of them."""
    native = "pymc_statespace_filters.compiler"
    places = (
        (f"{native}.native.entry_point", "_compiled"),
        (f"{native}.codegen.machine_code", "_addresses"),
    )
    symbols = [s for module, name in places for s in getattr(sys.modules.get(module), name, ())]
    if symbols:
        raise pytest.UsageError(f"importing test files must compile nothing, it did {symbols}")


def resident_mb():
    """Memory of this process, if the system tells."""
    if not MEMORY.exists():
        return None
    return int(MEMORY.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE") // 2**20


class Costs:
    """CPU seconds, compilations by numba, and memory, at the end of each test file."""

    def __init__(self, file):
        self.file, self.n_compiled, self.before = file, 0, None

    def now(self):
        return sum(os.times()[:4]), self.n_compiled

    def pytest_collection_finish(self):
        from numba.core import event  # not in the process that starts the others

        class Listener(event.Listener):
            """`numba:compile` lacks the entry points; whatever numba compiles, it lowers once."""

            def on_start(_, event):
                self.n_compiled += event.data["name"].startswith("native_lowering")

            def on_end(_, event):
                pass

        event.register("numba:run_pass", Listener())
        free_pass_managers()
        compiled_on_import()
        gc.freeze()  # what was imported stays
        self.before = self.now()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item, nextitem):
        try:
            return (yield)
        finally:
            if nextitem is None or nextitem.path != item.path:
                self.end_file(item.nodeid.partition("::")[0])

    def end_file(self, name):
        # Models and graphs are cycles, which the rare collections of `conftest` leave for long.
        # What a file keeps is not visited again.
        gc.collect()
        gc.freeze()
        before, self.before = self.before, self.now()
        seconds, n = (b - a for a, b in zip(before, self.before, strict=True))
        if self.file:
            cost = {"file": name, "cpu": round(seconds, 1), "compilations": n}
            with open(self.file, "a", encoding="utf-8") as lines:
                lines.write(json.dumps(cost | {"resident_mb": resident_mb()}) + "\n")

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        """Add what a process has compiled that has ended, and reports it unless it crashed."""
        self.n_compiled += getattr(node, "workeroutput", {}).get("n_compiled", 0)

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["n_compiled"] = self.n_compiled
        elif self.n_compiled > MOST:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        if self.n_compiled > MOST:
            terminalreporter.write_line(
                f"{self.n_compiled} functions were compiled, {KNOWN} are known in {__file__}",
                red=True,
            )
