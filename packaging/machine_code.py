"""Compile the functions that know nothing of a user's equations, for the wheel that carries them.

`release_check.py` runs this in an environment in which the pure wheel is installed. For each level
of x86-64 that this processor has, short studies run with an empty cache, compiled for that level,
and numba's files of it are kept with a manifest, as `compiler.native.shipped_code` reads them.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

V2 = "cmov crc32 cx16 cx8 fxsr mmx popcnt sahf sse sse2 sse3 sse4.1 sse4.2 ssse3"
V3 = f"{V2} avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave"
V4 = f"{V3} avx512bw avx512cd avx512dq avx512f avx512vl"
# By the names that LLVM has for the levels of the psABI; `shipped_code` takes the last that it can.
LEVELS = {f"x86-64-v{n}": [f"+{one}" for one in v.split()] for n, v in ((3, V3), (4, V4))}


def variables(level: str, cache: Path) -> dict[str, str]:
    """The environment in which numba compiles for a level, into this folder."""
    return {
        "NUMBA_CPU_NAME": level,
        "NUMBA_CPU_FEATURES": ",".join(LEVELS[level]),
        "PYTENSOR_FLAGS": f"base_compiledir={cache.as_posix()},cxx=",
    }


def levels_of_this_processor() -> list[str]:
    """The levels whose code runs here; on Linux alone, where they are tested."""
    import llvmlite.binding as llvm

    if sys.platform != "linux":
        return []
    here = set(llvm.get_host_cpu_features().flatten().split(","))
    return [level for level, features in LEVELS.items() if here.issuperset(features)]


def run_studies(level: str, cache: Path, *arguments: str | Path) -> str:
    """Run the studies on an empty cache, compiled for a level; what is printed."""
    return subprocess.run(
        [sys.executable, "-W", "ignore", __file__, "studies", *arguments],
        env=os.environ | variables(level, cache),
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    ).stdout.split()[-1]


def keep(folder: Path, numbers: str) -> None:
    """Keep numba's files of this process, and say what they are and which numbers they give."""
    from numba.core.registry import cpu_target
    from pytensor.link.numba import cache

    from pymc_statespace_filters.compiler.native.shipped_code import MANIFEST, versions

    folder.mkdir(parents=True)
    checksums = {}
    for file in sorted(cache.NUMBA_CACHE_PATH.glob("*.nb[ic]")):
        shutil.copy(file, folder)
        checksums[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
    for parsed in cache.NUMBA_CACHE_PATH.glob("*.json"):  # the sources, see `cache_key`
        shutil.copy(parsed, folder.parent)
    target = cpu_target.target_context.codegen().magic_tuple()
    manifest = {"versions": versions(), "target": target, "numbers": numbers}
    text = json.dumps(manifest | {"checksums": checksums}, indent=1)
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def check(level: str, cache: Path) -> None:
    """The code of a level comes from the wheel, and gives the numbers of own compilation."""
    from pymc_statespace_filters.compiler.native.shipped_code import FOLDER, MANIFEST

    manifest = json.loads((FOLDER / level / MANIFEST).read_text(encoding="utf-8"))
    if run_studies(level, cache) != manifest["numbers"]:
        sys.exit(f"the code for {level} gives other numbers than its compilation gave")
    if compiled := sorted(file.name for file in cache.rglob("*.nbi")):
        sys.exit(f"the wheel has no code for {level} of {', '.join(compiled)}")


def studies() -> Iterator[object]:
    """What most users run, for one state and for two, with one noise and with two; its numbers."""
    import numpy as np
    import pymc as pm

    import pymc_statespace_filters as psf

    def spring(x, a):
        return [x[1], -a * x[0]]

    few = {"random_seed": 1, "progressbar": False}
    filters = [psf.EKF(), psf.GuidedPF(20), psf.BootstrapPF(50), psf.GridFilter()]
    for drift, diffusion, n_observables in (
        (lambda x, a: [a * x[0] - x[0] ** 3], [[0.8]], 1),
        (spring, [[0.0], [0.3]], 1),
        (spring, [[0.1, 0.0], [0.0, 0.3]], 2),
    ):
        n = len(diffusion)
        system = psf.StateSpaceModel(
            psf.EulerMaruyama(drift, diffusion, dt=0.05),
            observation=(lambda x: [x[0]]) if n_observables == 1 else (lambda x: x),
            observation_noise=0.01 * np.eye(n_observables),
            initial_mean=np.eye(n)[0],
            initial_cov=0.01 * np.eye(n),
        )
        steps = np.arange(2, 41, 2)
        observed = psf.simulate(system, {"a": 1.0}, steps=steps, random_seed=1)["observations"]
        data = {"steps": steps, "observed": observed.values}
        for filter in filters if n == 1 else filters[:-1]:  # a grid is of one state
            yield psf.log_likelihood(system, filter, {"a": np.array([1.0, 1.1])}, **data)
            yield psf.run_filter(system, filter, {"a": 1.0}, **data)["mean"].values
            with pm.Model():
                pm.LogNormal("a", 0, 0.3)
                psf.StateSpace("d", system, filter, **data)
                idata = psf.sample_dram(100, tune=100, compute_convergence_checks=False, **few)
                yield idata.posterior["a"].values
                for states in (psf.filtered_states, psf.smoothed_states):
                    states(idata, n_draws=2, **few)
                psf.forecast(idata, n_steps=2, n_draws=2, **few)
                psf.estimate_evidence(idata, **few)
                if filter is filters[0]:
                    psf.sample(100, tune=100, until_ess=None, sampler="nuts", **few)


def main() -> None:
    """``build FOLDER``, ``check``, or what these run for each level: ``studies [FOLDER]``."""
    task, *folder = sys.argv[1:]
    if task == "studies":
        numbers = hashlib.sha256(b"".join(map(bytes, studies()))).hexdigest()
        print(numbers)
        if folder:
            keep(Path(*folder), numbers)
        return
    for level in levels_of_this_processor():
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
            if task == "build":
                run_studies(level, Path(cache), Path(*folder, level))
            else:
                check(level, Path(cache))


if __name__ == "__main__":
    main()
