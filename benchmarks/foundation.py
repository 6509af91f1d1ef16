"""Times of the likelihoods and of sampling, side by side in one run.

Every row is a median of CPU times in this process (children for the cold starts), taken in turn
with the row that it is compared with. Models are written as a user writes them and timed through
the compiled function of a PyMC model; the cost of calling it from Python is a row of its own.

Run ``python benchmarks/foundation.py`` (or ``make bench``); the table goes to the screen and to
``out/benchmarks.csv``.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numba
import numpy as np
import pandas as pd
import pymc as pm
import pytensor
from pymc.pytensorf import join_nonshared_inputs

import pymc_statespace_filters as psf

STEPS = np.arange(0, 2001, 20)
TRUTH = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.1}


def drift(x, alpha, beta):
    return [alpha * x[0] + beta * x[0] ** 3]


def diffusion(sigma_m):
    return [[0.6, sigma_m]]


double_well = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=0.01),
    observation=lambda x: [x[0]],
    observation_noise=[[0.08]],
    initial_mean=[1.0],
    initial_cov=[[0.5]],
)
RECORD = psf.simulate(double_well, TRUTH, steps=STEPS, random_seed=1)["observations"].values


def model_with(filter) -> pm.Model:
    with pm.Model() as model:
        pm.Normal("alpha", 0, 10)
        pm.Normal("beta", 0, 10)
        pm.HalfNormal("sigma_m", 1)
        psf.StateSpace("d", double_well, filter, steps=STEPS, observed=RECORD)
    return model


def compiled(model: pm.Model, gradient: bool = False):
    """The model's log-density of one vector: PyTensor's function, and the machine code in it."""
    point = model.initial_point()
    (logp,), q = join_nonshared_inputs(point, [model.logp()], model.value_vars)
    outputs = [logp, pytensor.grad(logp, q)] if gradient else [logp]
    function = pytensor.function([q], outputs)
    storage = [cell.storage[0] for cell in function.input_storage[1:]]
    return function, lambda at: function.vm.jit_fn(at, *storage)


@numba.njit(error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def scalar_ekf(theta, steps, observed):
    """The extended Kalman filter of the double well, written by hand."""
    alpha, beta, sigma = theta[0], theta[1], np.exp(theta[2])
    x, P, total, k = 1.0, 0.5, 0.0, 0
    noise = 0.01 * (0.36 + sigma * sigma)
    for j in range(steps.size):
        while k < steps[j]:
            a = 1.0 + 0.01 * (alpha + 3.0 * beta * x * x)
            x = x + 0.01 * (alpha * x + beta * x * x * x)
            P = a * P * a + noise
            k += 1
        S = P + 0.08
        v = observed[j, 0] - x
        total += -0.5 * (np.log(2.0 * np.pi * S) + v * v / S)
        K = P / S
        x += K * v
        P = (1.0 - K) * P
    return total


def in_turn(functions: dict, repeats: int, inner: dict[str, int]) -> dict[str, float]:
    """Median CPU seconds of each function, measured one after the other, round and round."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.process_time()
            for _ in range(inner[name]):
                function()
            times[name].append((time.process_time() - start) / inner[name])
    return {name: float(np.median(t)) for name, t in times.items()}


def kernel_rows() -> list[tuple[str, float, str]]:
    at = np.array([4.0, -4.0, np.log(0.1)])
    function, value = compiled(model_with(psf.EKF()))
    _, value_and_gradient = compiled(model_with(psf.EKF()), gradient=True)
    functions = {
        "EKF, scalar loop by hand": lambda: scalar_ekf(at, STEPS, RECORD),
        "EKF value": lambda: value(at),
        "EKF value and gradient": lambda: value_and_gradient(at),
        "EKF value, called from Python": lambda: function(at),
    }
    inner = dict.fromkeys(functions, 200)
    for name, filter in {
        "EnKF, 1250 members": psf.EnKF(1250),
        "BootstrapPF, 1250 particles": psf.BootstrapPF(1250),
        "PFEnKF, 1000 particles": psf.PFEnKF(1000),
    }.items():
        _, estimate = compiled(model_with(filter))
        functions[name] = lambda estimate=estimate: estimate(at)
        inner[name] = 1
    for warm_up in functions.values():
        warm_up()
    t = in_turn(functions, 15, inner)
    hand, ekf = t["EKF, scalar loop by hand"], t["EKF value"]
    goals = {
        "EKF value": f"{ekf / hand:.2f} x the loop by hand (goal 2)",
        "EKF value and gradient": f"{t['EKF value and gradient'] / ekf:.2f} x the value (goal 3)",
        "EKF value, called from Python": "with the call from Python",
        "EnKF, 1250 members": "goal 15 ms",
        "BootstrapPF, 1250 particles": "goal 15 ms",
        "PFEnKF, 1000 particles": "goal 2 s",
    }
    return [(name, seconds, goals.get(name, "")) for name, seconds in t.items()]


COLD = """
import sys, time
sys.path.insert(0, {folder!r})
import foundation
start = time.perf_counter()
model = foundation.model_with(foundation.psf.EKF())
q = foundation.np.array([4.0, -4.0, -2.3])
foundation.compiled(model, gradient={gradient})[0](q)
print(time.perf_counter() - start)
"""


def cold_rows() -> list[tuple[str, float, str]]:
    """First call of a model in a process of its own, with an empty and then a filled cache."""
    rows = []
    for gradient, goals in (
        (False, ("goal 5 s", "goal 1.5 s")),
        (True, ("goal 10 s", "goal 1.5 s")),
    ):
        with tempfile.TemporaryDirectory() as cache:
            flags = f"base_compiledir={cache}"
            what = "value and gradient" if gradient else "value"
            for process, goal in zip(("first process", "second process"), goals, strict=True):
                code = COLD.format(folder=str(Path(__file__).parent), gradient=gradient)
                # The record is simulated on import, outside the measured time.
                out = subprocess.run(
                    [sys.executable, "-W", "ignore", "-c", code],
                    env=os.environ | {"PYTENSOR_FLAGS": flags},
                    capture_output=True,
                    text=True,
                    check=True,
                )
                rows.append((f"EKF {what}, {process}", float(out.stdout.split()[-1]), goal))
    return rows


def sampling_rows() -> list[tuple[str, float, str]]:
    """CPU time of a draw of DRAM after tuning, less its likelihood call."""
    model, draws = model_with(psf.EKF()), 20_000
    _, value = compiled(model)
    at = np.array([4.0, -4.0, np.log(0.1)])
    settings = {
        "chains": 1,
        "step": None,
        "progressbar": False,
        "compute_convergence_checks": False,
    }
    with model:
        settings["step"] = psf.DRAM(stages=1)
        times = []
        for n in (100, draws + 100):
            start = time.process_time()
            pm.sample(n, tune=500, random_seed=1, quiet=True, **settings)
            times.append(time.process_time() - start)
    value(at)
    call = in_turn({"call": lambda: value(at)}, 15, {"call": 200})["call"]
    per_draw = (times[1] - times[0]) / draws
    return [
        ("a draw of pm.sample(step=DRAM), EKF", per_draw, "all of it"),
        ("the same, less its likelihood call", per_draw - call, "goal 60 us"),
    ]


def main() -> None:
    rows = kernel_rows() + sampling_rows() + cold_rows()
    table = pd.DataFrame(rows, columns=["what", "seconds", "note"])
    table["microseconds"] = (table["seconds"] * 1e6).round(1)
    out = Path("out")
    out.mkdir(exist_ok=True)
    table.to_csv(out / "benchmarks.csv", index=False)
    print(table[["what", "microseconds", "note"]].to_string(index=False))


if __name__ == "__main__":
    main()
