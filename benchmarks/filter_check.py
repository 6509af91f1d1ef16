"""How often the check at the end of a run misses a filter that is off, or accuses one that is not.

Records of ten systems of two states, a linear one beside one with a sensor or a force that bends,
jumps or loses the sign, with random noise, length and parameters. The second state is seen by
itself, so that the exact log-likelihood is that of `GridFilter` for the first plus that of Kalman's
formulas for the second, while the check, which finds no exact filter, has particles alone. One
parameter is unknown; draws of its posterior under the filter come from a grid. The filter is off if
the log of its likelihood is more than three nats from the exact one in the mean of the draws, and
right within one nat. Run it with ``python -m benchmarks.filter_check`` from the root of the
repository; 300 records take some ten minutes of CPU time, and another number may be given.
"""

import sys
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.filters.budget import Budget
from pymc_statespace_filters.checks.filters.checks import check_model, outcomes_of

TABLE = Path(__file__).parents[1] / "docs" / "_static" / "filter_check.inc"
FILTERS = (psf.EKF(), psf.UKF(), psf.IPLF(), psf.EnKF(200), psf.GuidedPF(100))
BAD, GOOD = 3.0, 1.0  # nats
# As at the end of a run of so many evaluations: a second, or a tenth of its time.
SECONDS, SHARE, N_EVALUATIONS = 1.0, 0.1, 10_000
SPREADS = np.linspace(0.5, 0.99, 25)  # of the unknown parameter
N_COMPARED = 10  # draws


def straight(x):
    return 0.0


def double_well(x):
    return 0.2 * (x - x**3)


SENSORS = {
    "square": lambda x: x**2,
    "modulus": pt.abs,
    "sine": lambda x: pt.sin(2.0 * x),
    "ramp": lambda x: pt.maximum(x, 0.0),
    "dead zone": lambda x: x - pt.clip(x, -0.5, 0.5),
    "exponential": pt.exp,
    "saturated": pt.tanh,
    "bent": lambda x: x + 0.1 * x**2,
    "wavy": lambda x: x + 0.2 * pt.sin(3.0 * x),
    "double well": lambda x: x,
}
EXACT = psf.GridFilter(tolerance=1e-4)  # the kinks of sensors keep it from the default


def bent(name: str) -> psf.StateSpaceModel:
    """The state whose sensor or force is not linear, by itself."""
    sensor, force = SENSORS[name], double_well if name == "double well" else straight
    return psf.StateSpaceModel(
        transition=lambda x, q, a, s: [a * x[0] + force(x[0]) + s * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [sensor(x[0])],
        observation_noise=lambda r: [[r**2]],
        initial_mean=[0.5],
        initial_cov=[[1.0]],
    )


def with_linear_state(name: str) -> psf.StateSpaceModel:
    sensor, force = SENSORS[name], double_well if name == "double well" else straight
    return psf.StateSpaceModel(
        transition=lambda x, q, a, s: [a * x[0] + force(x[0]) + s * q[0], 0.8 * x[1] + q[1]],
        process_noise=np.eye(2),
        observation=lambda x: [sensor(x[0]), x[1]],
        observation_noise=lambda r: [[r**2, 0.0], [0.0, 0.3]],
        initial_mean=[0.5, 0.0],
        initial_cov=np.eye(2),
    )


LINEAR = psf.StateSpaceModel(
    transition=lambda x, q: [0.8 * x[0] + q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.3]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)
SYSTEMS = {name: (bent(name), with_linear_state(name)) for name in SENSORS}


class Result(NamedTuple):
    """A record: the error in nats, the outcome of the check, and its CPU seconds."""

    system: str
    filter: str
    error: float
    outcome: str
    seconds: float


def checked(number: int) -> Result | None:
    """Simulate a record and check a filter on it; None if filter or system diverges."""
    rng = np.random.default_rng(number)
    name = list(SENSORS)[number % len(SENSORS)]
    filter = FILTERS[(number // len(SENSORS)) % len(FILTERS)]
    alone, system = SYSTEMS[name]
    given = {"a": rng.uniform(0.6, 0.95), "s": np.exp(rng.uniform(-1.5, 0.5))}
    given["r"] = given["s"] * np.exp(rng.uniform(-2.5, 0.5))
    steps = np.arange(rng.integers(20, 120))
    made = psf.simulate(system, given, steps=steps, random_seed=number)
    observed = made["observations"].values
    if not np.isfinite(observed).all():  # the map of the double well throws wide states far out
        return None
    known = {key: given[key] for key in ("s", "r")}

    def by_filter(values: np.ndarray, n_seeds: int) -> np.ndarray:
        seeds = rng.integers(2**60, size=(len(values), n_seeds)) if filter.noisy else 0
        at = values[:, None] if filter.noisy else values
        params = {"a": at, **known}
        found = psf.log_likelihood(system, filter, params, observed, steps=steps, seed=seeds)
        totals = found.sum(axis=-1)
        return logsumexp(totals, axis=1) - np.log(n_seeds) if filter.noisy else totals

    by_filter(SPREADS[:1], 8)  # compiled
    began = time.process_time()
    density = by_filter(SPREADS, 8)
    each = (time.process_time() - began) / (SPREADS.size * (8 if filter.noisy else 1))
    allowed = max(SECONDS, SHARE * N_EVALUATIONS * each)
    if not np.isfinite(density).all():
        return None
    fine = np.linspace(SPREADS[0], SPREADS[-1], 2002)[1:-1]
    weights = np.exp(np.interp(fine, SPREADS, density - density.max()))
    draws = rng.choice(fine, size=(2, 200), p=weights / weights.sum())
    at = draws.ravel()[:N_COMPARED]
    exact = (
        psf.log_likelihood(alone, EXACT, {"a": at, **known}, observed[:, 0], steps=steps).sum(
            axis=-1
        )
        + psf.log_likelihood(LINEAR, psf.EKF(), {}, observed[:, 1], steps=steps).sum()
    )
    error = float(np.mean(by_filter(at, 16) - exact))
    if not np.isfinite(error):
        return None
    with pm.Model() as model:
        a = pm.Uniform("a", 0.5, 0.99)
        params = {"a": a, **known}
        psf.StateSpace("d", system, filter, params=params, steps=steps, observed=observed)
    idata = az.from_dict({"posterior": {"a": draws}})
    began = time.process_time()
    table = check_model(idata, model, filter=None, n_points=20, budget=Budget(allowed), rng=rng)
    seconds = time.process_time() - began
    return Result(name, type(filter).__name__, error, outcomes_of(table)["d"]["outcome"], seconds)


def share(part: np.ndarray, whole: np.ndarray) -> str:
    return f"{part.sum()} of {whole.sum()}" if whole.any() else "none"


def table_of(results: list[Result]) -> str:
    """A row for each filter, and one for all."""
    lines = ["| filter | records | off by > 3 nats | silent | within a nat | accused | undecided |"]
    lines.append("| --- " * 7 + "|")
    for name in [*dict.fromkeys(one.filter for one in results), "all"]:
        own = [one for one in results if name in ("all", one.filter)]
        error = np.abs([one.error for one in own])
        outcome = np.array([one.outcome for one in own])
        bad, good = error > BAD, error <= GOOD
        cells = [
            len(own),
            bad.sum(),
            share(bad & (outcome == "no sign"), bad),
            good.sum(),
            share(good & (outcome == "off"), good),
            share(outcome == "undecided", np.full(len(own), True)),
        ]
        shown = name if name == "all" else f"`{name}`"
        lines.append(f"| {shown} | {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def main(n_records: int) -> None:
    results = []
    for number in range(n_records):
        found = checked(number)
        if found is not None:
            results.append(found)
            print(*found, sep=", ", flush=True)
            TABLE.write_text(table_of(results))
    print(table_of(results))


if __name__ == "__main__":
    warnings.simplefilter("ignore", psf.errors.FilterWarning)
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
