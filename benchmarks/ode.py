"""An ordinary differential equation: its likelihood and its posterior, here and elsewhere.

Chains start at the parameters of the record, one per seed. Their cost is that of an effective draw:
CPU seconds of the whole run, tuning included and compilation not, divided by the smallest bulk
effective sample size of the eight parameters.
"""

import logging
import os
import subprocess
import time
from collections.abc import Callable, Sequence

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from arviz_stats.base import array_stats
from pytensor.compile.ops import as_op
from scipy.integrate import odeint

import pymc_statespace_filters as psf
from benchmarks import loops, lynx_hare
from benchmarks.measure import FOLDER, ROOT, Peers, Row, compare
from benchmarks.ours import Likelihood
from benchmarks.peers.client import ONE_THREAD
from benchmarks.timing import Timed, summary

OURS = "ours"
AT, LOGS, NAMES, STEPS, TIMES = (
    getattr(lynx_hare, name) for name in ("AT", "LOGS", "NAMES", "STEPS", "TIMES")
)
SCIPY = "SciPy odeint"


def ode(peers: Peers) -> list[Row]:
    """Value, value and gradient, and chains."""
    likelihood = Likelihood(
        lynx_hare.SYSTEM,
        psf.EKF(),
        dict(zip(NAMES, AT, strict=True)),
        steps=STEPS,
        observed=LOGS,
    )
    values = {
        OURS: likelihood.value,
        "numba loop by hand": lambda: Timed(lambda s: loops.ode_lynx_hare(AT, STEPS, LOGS)),
        SCIPY: lambda: Timed(lambda s: by_odeint(AT)),
        "diffrax": lambda: peers.task("diffrax_ode", "value"),
    }
    gradients = {
        OURS: likelihood.value_and_gradient,
        "pm.ode": lambda: Timed(by_pymc_ode()),
        "diffrax": lambda: peers.task("diffrax_ode", "gradient"),
    }
    notes = {
        OURS: "1000 Runge-Kutta steps",
        "numba loop by hand": "the same steps",
        "diffrax": "Tsit5, adaptive steps, tolerance 1e-6",
    }
    what = "ODE of lynx and hare"
    return [
        *compare(f"{what}: value", values, notes=notes),
        *compare(f"{what}: value and gradient", gradients, notes=notes, rounds=5),
        *chains(f"{what}: an effective draw"),
    ]


def rates(x, t, alpha, beta, gamma, delta):
    hare, lynx = x
    return (alpha - beta * lynx) * hare, (delta * hare - gamma) * lynx


def by_odeint(theta: np.ndarray) -> float:
    """The log-likelihood by SciPy, with its default tolerances."""
    path = odeint(rates, theta[4:6], TIMES, tuple(theta[:4]))
    z = (LOGS - np.log(np.maximum(path, 1e-300))) / theta[6:]
    return -0.5 * np.sum(z**2) - len(TIMES) * np.sum(np.log(theta[6:] * np.sqrt(2.0 * np.pi)))


def by_pymc_ode() -> Callable[[int], float]:
    """The likelihood and its gradient by ``pm.ode``."""
    model = lynx_hare.by_pymc_ode()
    values = [model[name] for name in NAMES]
    likelihood = pm.logp(model["d"], LOGS).sum()
    run = pytensor.function(values, [likelihood, *pytensor.grad(likelihood, values)])
    return lambda seed: run(*AT)[0]


def by_black_box() -> pm.Model:
    """The posterior by SciPy as an operation without a gradient."""
    operation = as_op(itypes=[pt.dvector], otypes=[pt.dscalar])(
        lambda theta: np.asarray(by_odeint(theta))
    )
    with pm.Model() as model:
        p = lynx_hare.priors()
        pm.Potential("d", operation(pt.stack([p[name] for name in NAMES])))
    return model


def chains(work: str) -> list[Row]:
    """CPU seconds of an effective draw by several samplers."""
    logging.getLogger("pymc").setLevel(logging.ERROR)  # of short chains
    nuts = {"nuts_sampler": "pymc"}
    return [
        in_pymc(work, OURS, lynx_hare.by_filter, 1000, 2000),
        in_pymc(work, f"{OURS}, NUTS of PyMC", lynx_hare.by_filter, 1000, 2000, **nuts),
        in_pymc(work, "pm.ode, NUTS of PyMC", lynx_hare.by_pymc_ode, 150, 150, seeds=2, **nuts),
        in_pymc(
            work, f"{SCIPY}, DEMetropolisZ", by_black_box, 10_000, 20_000, step=pm.DEMetropolisZ
        ),
        in_numpyro(work, 1000, 2000),
    ]


def in_pymc(
    work: str,
    who: str,
    make: Callable[[], pm.Model],
    tune: int,
    draws: int,
    *,
    seeds: int = 3,
    step: Callable | None = None,
    **options,
) -> Row:
    """Chains of ``pm.sample``; the time of a run of one draw, which compiles, is subtracted."""

    def run(seed: int, tune: int, draws: int) -> tuple[np.ndarray, float]:
        begin = time.process_time()
        idata = pm.sample(
            draws,
            tune=tune,
            chains=1,
            cores=1,
            step=None if step is None else step(),
            initvals=dict(zip(NAMES, AT, strict=True)),
            random_seed=seed,
            progressbar=False,
            quiet=True,
            compute_convergence_checks=False,
            **options,
        )
        seconds = time.process_time() - begin
        return np.stack([idata.posterior[name].values[0] for name in NAMES], axis=1), seconds

    with make():
        run(0, 1, 1)
        before = np.median([run(0, 1, 1)[1] for _ in range(3)])
        found, seconds = zip(*(run(seed, tune, draws) for seed in range(seeds)), strict=True)
    return row(work, who, found, np.array(seconds) - before)


def in_numpyro(work: str, tune: int, draws: int, seeds: int = 3) -> Row:
    """Chains of numpyro with diffrax, in their own process."""
    who, target = "diffrax, NUTS of numpyro", FOLDER / "diffrax.npz"
    python = ROOT / ".venv-bench" / "bin" / "python"
    if not python.exists():
        return Row(work, who, None, note="no environment .venv-bench")
    command = [python, "-W", "ignore", "-m", "benchmarks.peers.diffrax_ode"]
    done = subprocess.run(
        [*command, FOLDER / "records.npz", target, *map(str, (seeds, tune, draws))],
        cwd=ROOT,
        env=os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        return Row(work, who, None, note=done.stderr.strip().split("\n")[-1][:200])
    result = np.load(target)
    return row(work, who, result["chains"], result["seconds"])


def row(work: str, who: str, chains: Sequence[np.ndarray], seconds: np.ndarray) -> Row:
    """A row of chains (seed, draw, parameter) and their CPU seconds."""
    smallest = [
        min(array_stats.ess(chain[None, :, i]) for i in range(len(NAMES))) for chain in chains
    ]
    each = seconds / np.array(smallest)
    return Row(work, who, summary(each), note=f"{np.median(1.0 / each):.3g} effective draws per s")
