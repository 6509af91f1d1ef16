"""What a drifting parameter costs, and how well its strength mixes.

The first table has CPU times of a log-likelihood of a Duffing oscillator, 1000 observations, whose
stiffness drifts, and their ratios to the constant system; the second, effective draws of the
parameters of a leaking tank whose outlet is constant, where the strength is near zero, or drifts.
Run it with ``python -m benchmarks.drifting`` from the root of the repository; it takes a minute.
"""

import time

import arviz as az
import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from benchmarks.timing import Timed, in_turn
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record

OSCILLATOR = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x, k, c: [x[1], -k * x[0] - x[0] ** 3 - c * x[1]], lambda s: [[0.0], [s]], dt=0.1
    ),
    observation=lambda x: [x[0]],
    observation_noise=[[0.01]],
    initial_mean=[1.0, 0.0],
    initial_cov=0.1 * np.eye(2),
)
TRUTH = {"k": 1.0, "c": 0.3, "s": 0.3, "k_strength": 0.1, "k_rate": 0.5}
SYSTEMS = {
    "constant": OSCILLATOR,
    "random walk": psf.drifting(OSCILLATOR, k=psf.RandomWalk()),
    "of the logarithm": psf.drifting(OSCILLATOR, k=psf.RandomWalk(scale="log")),
    "held for 10 steps": psf.drifting(OSCILLATOR, k=psf.RandomWalk(scale="log", every=10)),
    "Ornstein-Uhlenbeck": psf.drifting(OSCILLATOR, k=psf.OrnsteinUhlenbeck(scale="log")),
}
TANK = psf.drifting(
    psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, u, k: [u[0] - k * x[0]], lambda sigma: [[sigma]], dt=0.1
        ),
        observation=lambda x: [x[0]],
        observation_noise=[[0.01]],
        initial_mean=[1.0],
        initial_cov=[[0.01]],
        inputs=["inflow"],
    ),
    k=psf.RandomWalk(scale="log"),
)
STEPS = np.arange(5, 301, 5)
INFLOW = 1 + 0.5 * np.sin(np.arange(300) * 0.05)


def costs(filter) -> dict[str, float]:
    """CPU seconds of an evaluation of each system."""
    steps = np.arange(1001)
    constant = {name: TRUTH[name] for name in OSCILLATOR.parameters}
    record = psf.simulate(OSCILLATOR, constant, steps=steps, random_seed=1)["observations"].values
    contenders = {}
    for name, system in SYSTEMS.items():
        run = evaluator(LogLikelihood(system, filter))
        theta = flat_parameters(system, {one: TRUTH[one] for one in system.parameters})
        arguments = (theta, *read_record(system, GivenRecord(record, steps=steps)).arguments)
        contenders[name] = Timed(lambda seed, run=run, given=arguments: run(*given, np.int64(seed)))
        contenders[name].warm_up()
    return {name: timing.median for name, timing in in_turn(contenders, 9).items()}


def mixing(strength: float, sampler: str) -> None:
    """Print effective draws of 4000, where the outlet has drifted with this strength."""
    truth = {"k": 1.0, "k_strength": strength, "sigma": 0.05}
    record = psf.simulate(TANK, truth, steps=STEPS, inputs=INFLOW, random_seed=5)
    with pm.Model():
        pm.LogNormal("k", 0, 0.5)
        pm.HalfNormal("k_strength", 0.3)
        pm.HalfNormal("sigma", 0.1)
        observed = record["observations"].values
        psf.StateSpace("d", TANK, psf.EKF(), steps=STEPS, observed=observed, inputs=INFLOW)
        start = time.process_time()
        idata = psf.sample(1000, tune=1000, sampler=sampler, random_seed=1, progressbar=False)
        seconds = time.process_time() - start
    rows = az.summary(idata, var_names=["k", "k_strength", "sigma"])
    print(f"strength {strength:g}, {sampler}, {seconds:.1f} CPU s with compilation")
    print(rows[["mean", "sd", "ess_bulk", "ess_tail", "r_hat"]], flush=True)


def main() -> None:
    for filter in (psf.EKF(), psf.GuidedPF(100)):
        seconds = costs(filter)
        for name, one in seconds.items():
            ratio = one / seconds["constant"]
            print(f"{filter!r:.9} | {name} | {1e6 * one:.0f} us | {ratio:.2f}", flush=True)
    for strength in (0.0, 0.15):
        for sampler in ("nuts", "dram"):
            mixing(strength, sampler)


if __name__ == "__main__":
    main()
