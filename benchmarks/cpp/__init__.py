"""The filters in C++, compiled on demand and called in this process, with stored noise."""

import ctypes
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.timing import Timed

OPTIONS = {
    "C++ -O2": ["-O2"],
    "C++ -O3 -march=native -ffast-math": ["-O3", "-march=native", "-ffast-math"],
}


def compiler() -> str:
    for name in ("g++", "clang++"):
        if path := shutil.which(name):
            return path
    raise NotImplementedError("no C++ compiler found")


@cache
def library(options: str, folder: Path) -> ctypes.CDLL:
    source = Path(__file__).parent / "library.cpp"
    target = folder / f"filters{''.join(OPTIONS[options])}"
    command = [compiler(), "-std=c++17", "-fPIC", *OPTIONS[options], "-c", source]
    subprocess.run([*command, "-o", f"{target}.o"], check=True)
    # Link without the options: -ffast-math would disable denormal numbers for the whole process.
    subprocess.run([compiler(), "-shared", f"{target}.o", "-o", f"{target}.so", "-lm"], check=True)
    return ctypes.CDLL(f"{target}.so")


class Cpp:
    """One filter of the library on one record."""

    def __init__(self, options: str, folder: Path, name: str, filter: str) -> None:
        self.run = getattr(library(options, folder), f"{name}_{filter}")
        self.run.restype = ctypes.c_double
        records = np.load(folder / "records.npz")
        self.n_states = {"double_well": 1, "mass_spring_damper": 2}[name]
        self.theta, self.steps = records[f"{name}_theta"], records["steps"].astype(np.int64)
        self.observed = np.ascontiguousarray(records[f"{name}_observed"][:, 0])
        self.inputs = records[f"{name}_inputs"]

    def _record(self) -> list:
        return [
            pointer(self.theta),
            pointer(self.steps),
            ctypes.c_int64(self.steps.size),
            pointer(self.observed),
            pointer(self.inputs),
        ]

    def deterministic(self) -> Timed:
        record = self._record()
        return Timed(lambda s: self.run(*record))

    def on_held_noise(self, n_members: int) -> Timed:
        """Return the task; the noise is in memory before the clock starts."""
        record = self._record()
        n_rows = self.n_states + self.steps[-1] + self.steps.size

        def draw(seed):
            random = np.random.default_rng(seed)
            return random.standard_normal((n_rows, n_members)), random.random(self.steps.size)

        def value(noise):
            return self.run(*record, *map(pointer, noise), ctypes.c_int64(n_members))

        return Timed(value, draw)


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
