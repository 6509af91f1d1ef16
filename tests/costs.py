"""A pytest plugin: what each test file costs, and whether it compiles more than it is known to.

The known counts are those of a file that runs alone on an empty cache: the only ones that do not
depend on what ran before, in the process or on the machine. No other run exceeds them, because it
does not compile what an earlier file has compiled. ``python -m tests.costs`` stores them; as long
as it has not, nothing is checked.
"""

import gc
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

ROOT = Path(__file__).parents[1]
STORED = ROOT / "tests" / "compilations.json"
SHARE, SLACK = 0.1, 5  # by which a file may exceed its count
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
        self.stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {}

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
        most = self.stored.get(name, n)
        if n > (1 + SHARE) * most + SLACK:
            pytest.fail(f"{name} compiles {n} functions, {most} in {STORED.name}", pytrace=False)


def alone(file):
    """The costs of a test file that runs alone on an empty cache."""
    with TemporaryDirectory() as folder:
        lines = Path(folder, "costs")
        flags = f"base_compiledir={folder},blas__ldflags=,cxx="
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "--costs", lines, file],
            cwd=ROOT, env=os.environ | {"PYTENSOR_FLAGS": flags}, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        return (
            [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()]
            if lines.exists()
            else []
        )


def main(*files):
    """Store the counts of some test files, or of all of them."""
    stored = json.loads(STORED.read_text(encoding="utf-8")) if files and STORED.exists() else {}
    files = files or sorted((ROOT / "tests").rglob("test_*.py"))
    STORED.unlink(missing_ok=True)  # nothing is checked meanwhile
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for costs in pool.map(alone, files):
            stored |= {cost["file"]: cost["compilations"] for cost in costs}
    STORED.write_text(json.dumps(dict(sorted(stored.items())), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
