"""Cost of the first call of a model, including compilation but not imports.

Each first call runs in its own process with an empty cache, then again in a second process, then
for another system with as many states and the same cache. `GridFilter` has one system here, and the
chain is that of a model without a filter, so that its row is the sampler's own cost.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass

from benchmarks.measure import ROOT
from benchmarks.peers.client import ONE_THREAD

TWO_STATES = 2, ("mass_spring_damper", "linear")
KINDS = {
    "EKF, value": "ours.of(name, psf.EKF()).value()",
    "EKF, value and gradient": "ours.of(name, psf.EKF()).value_and_gradient()",
    "EnKF(1250)": "ours.of(name, psf.EnKF(1250)).value()",
    "BootstrapPF(1250)": "ours.of(name, psf.BootstrapPF(1250)).value()",
    "GuidedPF(100)": "ours.of(name, psf.GuidedPF(100)).value()",
    "IPLF": "ours.of(name, psf.IPLF()).value()",
    "PFEnKF(250)": "ours.of(name, psf.PFEnKF(250)).value()",
    "GridFilter()": "ours.of(name, psf.GridFilter()).value()",
    "a chain by sample_dram": "chains.first_draws()",
}
# Number of states, and the systems.
SYSTEMS = {
    "GridFilter()": (1, ("double_well",)),
    "a chain by sample_dram": (0, ("double_well",)),
}

# Simulating the record compiles too, so do it before the clock starts.
CHILD = """
import sys, time
import pymc_statespace_filters as psf
from benchmarks import chains, ours
name = sys.argv[1]
ours.simulated = (lambda data: lambda *_: data)(ours.simulated(*ours.SYSTEMS[name]))
start = time.process_time()
({what}).function(0)
print(time.process_time() - start)
"""


@dataclass(frozen=True)
class Cold:
    """Return CPU seconds of the first call: empty cache, second process, another model."""

    kind: str
    states: int
    first: float
    second: float
    another: float | None


def seconds(what: str, name: str, cache: str) -> float:
    flags = {"PYTENSOR_FLAGS": f"base_compiledir={cache}", "NUMBA_CACHE_DIR": cache}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", CHILD.format(what=what), name],
        cwd=ROOT,
        env=os.environ | ONE_THREAD | flags | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.split()[-1])


def cold() -> list[Cold]:
    rows = []
    for kind, what in KINDS.items():
        n_states, (name, *others) = SYSTEMS.get(kind, TWO_STATES)
        with tempfile.TemporaryDirectory() as cache:
            first, second = (seconds(what, name, cache) for _ in range(2))
            another = seconds(what, others[0], cache) if others else None
        rows.append(Cold(kind, n_states, first, second, another))
    return rows
