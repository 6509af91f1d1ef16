"""Cost of the normals by the width of the vectors, and of the filters' noise."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass

import pymc_statespace_filters as psf
from benchmarks import ours
from benchmarks.measure import ROOT
from benchmarks.peers.client import ONE_THREAD
from benchmarks.timing import in_turn

# numba compiles for the processor that it is told to assume.
WIDTHS = {
    "the processor's own": {},
    "AVX2": {
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma,+bmi,+bmi2,+sse4.2,+lzcnt,+popcnt,+cmov,+sahf",
    },
    "SSE2": {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "+sse2,+cmov"},
}
N_NORMALS = 16_384
CHILD = """
import json
import numpy as np
from benchmarks.timing import Timed, in_turn
from pymc_statespace_filters.compiler.numerics.normals import fill_normals
row = np.empty((1, {n}))
rng = np.random.default_rng(1)
contenders = {{
    "ours": Timed(lambda seed: fill_normals(seed, np.uint64(1), 0, row, 0), per={n}),
    "numpy": Timed(lambda seed: rng.standard_normal(out=row), per={n}),
}}
for contender in contenders.values():
    contender.warm_up()
print(json.dumps({{who: t.median for who, t in in_turn(contenders, 9).items()}}))
"""
FILTERS = {
    "EnKF(1250)": psf.EnKF(1250),
    "BootstrapPF(1250)": psf.BootstrapPF(1250),
    "GuidedPF(1250)": psf.GuidedPF(1250),
    "PFEnKF(1250)": psf.PFEnKF(1250),
}


@dataclass(frozen=True)
class Normals:
    """CPU seconds of a standard normal: ours, compiled for vectors of a width, and NumPy's."""

    vectors: str
    ours: float
    numpy: float


@dataclass(frozen=True)
class Noise:
    """CPU seconds of an evaluation with fresh normals and with stored ones."""

    filter: str
    system: str
    fresh: float
    held: float


def normals() -> list[Normals]:
    rows = []
    for vectors, flags in WIDTHS.items():
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", CHILD.format(n=N_NORMALS)],
            cwd=ROOT,
            env=os.environ | ONE_THREAD | flags | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        )
        rows.append(Normals(vectors, **json.loads(done.stdout)))
    return rows


def noise() -> list[Noise]:
    """Filters without noise, the EKF and the GridFilter, have no such row."""
    rows = []
    for system in ("double_well", "mass_spring_damper"):
        for name, filter in FILTERS.items():
            likelihood = ours.of(system, filter)
            contenders = {"fresh": likelihood.value(), "held": likelihood.on_held_noise()}
            for contender in contenders.values():
                contender.warm_up()
            times = {kind: t.median for kind, t in in_turn(contenders, 5).items()}
            rows.append(Noise(name, system.replace("_", "-"), **times))
    return rows
