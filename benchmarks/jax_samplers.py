"""What JAX costs: an evaluation with gradient, and whole samplers on one model, side by side.

``python -m benchmarks.jax_samplers`` prints the two tables of `docs/howto/jax.md`; with ``calls``
or ``samplers``, one of them. It needs the extra ``jax``, and nutpie. All times are CPU times of
the process.
"""

import sys
import time
import warnings
from collections.abc import Callable

import arviz as az
import numpy as np
import pymc as pm
import pymc.sampling.jax as pymc_jax  # sets the number of JAX's devices, before it counts them

import pymc_statespace_filters as psf

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip

TRUTH = {"stiffness": 4.0, "hardening": 2.0, "damping": 0.3, "sigma": 0.5}
STEPS = np.arange(10, 2001, 10)
TUNE, FEW, MANY = 1000, 200, 2000
SETTINGS = {
    "chains": 4, "random_seed": 1, "progressbar": False, "compute_convergence_checks": False,
}  # fmt: skip


def drift(x, stiffness, hardening, damping):
    """A Duffing oscillator: position and speed."""
    return [x[1], -stiffness * x[0] - hardening * x[0] ** 3 - damping * x[1]]


OSCILLATOR = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, lambda sigma: [[0.0], [sigma]], dt=0.02),
    observation=lambda x: [x[0]],
    observation_noise=[[0.01]],
    initial_mean=[1.0, 0.0],
    initial_cov=[[0.1, 0.0], [0.0, 0.1]],
)


def oscillator() -> pm.Model:
    """Forty seconds, observed five times a second."""
    record = psf.simulate(OSCILLATOR, TRUTH, steps=STEPS, random_seed=1)
    with pm.Model() as model:
        pm.HalfNormal("stiffness", 10)
        pm.HalfNormal("hardening", 5)
        pm.HalfNormal("damping", 1)
        pm.HalfNormal("sigma", 1)
        psf.StateSpace("d", OSCILLATOR, psf.EKF(), steps=STEPS, observed=record["observations"])
    return model


def cpu_seconds(run: Callable, repeats: int, rounds: int = 5) -> float:
    """The fastest of several rounds, for each call."""
    run()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        for _ in range(repeats):
            run()
        times.append((time.process_time() - start) / repeats)
    return min(times)


def calls(model: pm.Model) -> None:
    """Microseconds for value and gradient: numba, JAX, and JAX inside a loop that it compiled."""
    by_numba = model.logp_dlogp_function(ravel_inputs=True, mode="NUMBA")
    by_numba.set_extra_values({})
    point = np.log(list(TRUTH.values()))
    function = by_numba._pytensor_function
    function.trust_input = True
    numba = cpu_seconds(lambda: function(point), 500)
    logp = pymc_jax.get_jaxified_logp(model)
    one = jax.value_and_grad(lambda x: logp([*x]))
    print(f"{'points':>6}{'numba':>9}{'JAX':>9}{'in a loop':>11}")
    for n in (1, 4, 16, 64):
        points = jnp.asarray(point if n == 1 else np.tile(point, (n, 1)))
        both = one if n == 1 else jax.vmap(one)

        def loop(x, both=both):
            def step(x, _):
                value, gradient = both(x)
                return x + 0.0 * (jnp.sum(value) + gradient), None

            return jax.lax.scan(step, x, None, length=200)[0]

        single, looped = jax.jit(both), jax.jit(loop)
        times = (
            n * numba,
            cpu_seconds(lambda f=single, x=points: jax.block_until_ready(f(x)), 200),
            cpu_seconds(lambda f=looped, x=points: jax.block_until_ready(f(x)), 1) / 200,
        )
        print(f"{n:6}{times[0] * 1e6:9.0f}{times[1] * 1e6:9.0f}{times[2] * 1e6:11.0f}")


def numpyro(chain_method: str) -> Callable:
    """NUTS of NumPyro."""
    return lambda **kw: pm.sample(nuts_sampler="numpyro", nuts={"chain_method": chain_method}, **kw)


SAMPLERS: dict[str, Callable] = {
    "nutpie, numba": lambda **kw: pm.sample(nuts_sampler="nutpie", **kw),
    "nutpie, JAX": lambda **kw: pm.sample(nuts_sampler="nutpie", backend="jax", **kw),
    "numpyro": numpyro("parallel"),
    "numpyro, vectorized": numpyro("vectorized"),
    "blackjax": lambda **kw: pm.sample(nuts_sampler="blackjax", **kw),
    "sample_dram": lambda compute_convergence_checks, **kw: psf.sample_dram(**kw),
}


def samplers(model: pm.Model) -> None:
    """The smallest effective number of draws and the CPU seconds, in all and for further draws.

    Two runs differ in their number of draws alone: the rest is compilation and tuning.
    """
    print(f"{'':>20}{'ESS':>7}{'seconds':>9}{'ESS/s':>8}{'further ESS/s':>15}")
    for name, sample in SAMPLERS.items():
        seconds = {}
        with model, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sample(draws=10, tune=10, **SETTINGS)  # puts on disk what the package compiles
            for draws in (FEW, MANY):
                start = time.process_time()
                idata = sample(draws=draws, tune=TUNE, **SETTINGS)
                seconds[draws] = time.process_time() - start
        ess = float(az.ess(idata["posterior"].to_dataset()).to_array().min())
        further = ess * (1 - FEW / MANY) / (seconds[MANY] - seconds[FEW])
        in_all = seconds[MANY]
        print(f"{name:>20}{ess:7.0f}{in_all:9.1f}{ess / in_all:8.0f}{further:15.0f}")


def main() -> None:
    """Print the tables that are asked for."""
    model = oscillator()
    for table in (calls, samplers):
        if table.__name__ in (sys.argv[1:] or ["calls", "samplers"]):
            table(model)


if __name__ == "__main__":
    main()
