"""Numbers of all filters in all forms, stored bit for bit, to see whether a change moves any.

``python -m benchmarks.corpus save FILE`` before it, ``python -m benchmarks.corpus compare FILE``
after it, on the same machine; a few minutes each. The bits belong to the processor and to the
versions of NumPy, numba and PyTensor, so the file is of no use elsewhere.
"""

import argparse
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.distributed import distributed_evaluator
from tests.ranks import on_ranks

Arrays = dict[str, np.ndarray]
Evaluations = Iterator[tuple[str, Callable[[], Any]]]  # by name; the values when called

SIGMA_POINTS = {"UKF": psf.UKF(), "IPLF": psf.IPLF()}
GAUSSIAN = {"EKF": psf.EKF()} | SIGMA_POINTS
GRID = {"GridFilter": psf.GridFilter()}
ENSEMBLES = {
    "EnKF ensemble": psf.EnKF(130),
    "EnKF gaussian": psf.EnKF(130, likelihood="gaussian"),
}
KERNELS = {
    "PFEnKF predictive": psf.PFEnKF(130),
    "PFEnKF weights": psf.PFEnKF(130, likelihood="weights"),
}
BOOTSTRAPS = {
    "BootstrapPF systematic": psf.BootstrapPF(200),
    "BootstrapPF multinomial": psf.BootstrapPF(200, resampling="multinomial"),
    "BootstrapPF sorted": psf.BootstrapPF(200, resampling="sorted", resample_below=1.0),
}
GUIDED = {"GuidedPF": psf.GuidedPF(200)}
PARTICLES = BOOTSTRAPS | GUIDED
ALL = GAUSSIAN | ENSEMBLES | KERNELS | PARTICLES


@dataclass(frozen=True)
class Case:
    """A system, parameters, a record, and the filters that treat the system."""

    system: psf.StateSpaceModel
    params: dict[str, Any]
    observed: np.ndarray
    steps: np.ndarray
    filters: dict[str, Any]
    inputs: np.ndarray | None = None
    fails: dict[str, float] = field(default_factory=dict)  # changes with which all filters fail

    @property
    def record(self) -> dict[str, Any]:
        return {"observed": self.observed, "steps": self.steps, "inputs": self.inputs}

    @property
    def points(self) -> dict[str, np.ndarray]:
        """Three points, at the last of which the filters fail."""
        near = {name: np.array([1.0, 0.97, 1.0]) * value for name, value in self.params.items()}
        for name, value in self.fails.items():
            near[name] = np.array([*near[name][:2], value])
        return near

    @property
    def panel(self) -> dict[str, Any]:
        """Three records of different lengths, with inputs for all of them."""
        lengths = (len(self.steps), 2, len(self.steps) - 1)
        rows = np.concatenate([np.arange(length) for length in lengths])
        return {
            "observed": self.observed[rows] + 0.1 * (np.arange(len(rows)) % 2)[:, None],
            "steps": self.steps[rows],
            "panel": np.repeat(["a", "b", "c"], lengths),
            "inputs": self.inputs,
        }


def _linear() -> Case:
    system = psf.StateSpaceModel(
        transition=lambda x, q, a, b: [a * x[0] + b * x[1] + q[0], 0.8 * x[1] + q[1]],
        process_noise=[[1.0, 0.1], [0.1, 0.5]],
        observation=lambda x: [x[0], x[1]],
        observation_noise=lambda r: [[r, 0.1], [0.1, 0.4]],
        initial_mean=[0.0, 0.3],
        initial_cov=[[1.0, 0.0], [0.0, 2.0]],
    )
    observed = [[0.1, 0.2], [np.nan, 0.3], [np.nan, np.nan], [0.5, -0.1], [1.9, 0.4], [0.7, np.nan]]
    steps = np.array([0, 2, 3, 6, 7, 12])
    return Case(
        system, {"a": 0.9, "b": 0.2, "r": 0.5}, np.array(observed), steps, ALL, fails={"r": -2.0}
    )


def _double_well() -> Case:
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, alpha, beta: [alpha * x[0] + beta * x[0] ** 3],
            lambda sigma: [[0.6, sigma]],
            dt=0.02,
        ),
        observation=lambda x: [x[0]],
        observation_noise=lambda gamma: [[gamma]],
        initial_mean=[1.0],
        initial_cov=[[0.5]],
    )
    params = {"alpha": 4.0, "beta": -4.0, "sigma": 0.1, "gamma": 0.08}
    observed = np.array([0.9, 1.2, np.nan, -0.8, -1.1, 0.7])[:, None]
    steps = np.array([0, 40, 80, 120, 160, 200])
    return Case(system, params, observed, steps, ALL | GRID, fails={"gamma": -1.0})


def _oscillator() -> Case:
    def drift(x, u, c, k, c3, k_f):
        force = psf.mechanics.cubic(x[0], k, c3) + psf.mechanics.freeplay(x[0], k_f, 0.2)
        return [x[1], u[0] - c * x[1] - force]

    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda sigma: [[0.0], [sigma]], dt=0.05, substeps=2),
        observation=lambda x: [x[0], x[1] * x[0]],
        observation_noise=[[0.02, 0.0], [0.0, 0.05]],
        initial_mean=lambda x0: [x0, 0.0],
        initial_cov=0.1 * np.eye(2),
        inputs=["force"],
    )
    params = {"c": 0.4, "k": 4.0, "c3": 2.0, "k_f": 1.5, "sigma": 0.3, "x0": 0.5}
    observed = [[0.5, 0.0], [0.4, -0.1], [np.nan, -0.2], [0.3, np.nan], [-0.2, 0.0], [-0.4, -0.1]]
    steps, push = np.array([1, 4, 8, 12, 20, 24]), np.sin(np.arange(40) / 5.0)[:, None]
    fails = {"c3": np.inf}
    return Case(system, params, np.array(observed), steps, ALL, push, fails)


def _counts() -> Case:
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=lambda s: [[s**2]],
        observation_dist=lambda x, c: [
            pm.Poisson.dist(mu=pt.exp(c + x[0])),
            pm.NegativeBinomial.dist(mu=pt.exp(0.5 * x[0]) + 0.1, alpha=3.0),
        ],
        initial_mean=[0.0],
        initial_cov=[[0.3]],
    )
    observed = [[2.0, 1.0], [4.0, np.nan], [np.nan, np.nan], [0.0, 3.0], [7.0, 2.0]]
    filters = {"IPLF": psf.IPLF()} | PARTICLES | GRID
    params, steps = {"a": 0.9, "s": 0.4, "c": 0.7}, np.array([1, 2, 3, 5, 8])
    return Case(system, params, np.array(observed), steps, filters, fails={"c": np.inf})


def _epidemic() -> Case:
    """Counts of a map, with a total since the last report."""

    def events(x, t, rate, sigma):
        noise = psf.compartments.gamma_white_noise(sigma, 1.0)
        season = 1.0 + 0.2 * pt.cos(t)
        infected = psf.compartments.euler_multinomial(
            x[0], [rate * season * noise * x[1] / 1000.0, 0.01], 1.0
        )
        return [
            pm.Poisson.dist(5.0),
            *infected,
            *psf.compartments.euler_multinomial(x[1], [0.3], 1.0),
        ]

    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0] - q[1] - q[2], x[1] + q[1] - q[3], x[2] + q[1]],
        process_dist=events,
        observation_dist=lambda x, rho: [pm.NegativeBinomial.dist(rho * x[2] + 0.1, 10.0)],
        initial_dist=lambda: [pm.Poisson.dist(950.0), pm.Poisson.dist(40.0), 0],
        states=["S", "I", "cases"],
        accumulators=["cases"],
        resets="row",
    )
    params, steps = {"rate": 0.7, "sigma": 0.3, "rho": 0.5}, np.array([3, 6, 9, 12, 15])
    observed = np.array([30.0, 60.0, np.nan, 70.0, 30.0])[:, None]
    filters = BOOTSTRAPS | {name: ALL[name] for name in ("IPLF", "PFEnKF predictive")}
    return Case(system, params, observed, steps, filters, fails={"rho": -1.0})


def _equation() -> Case:
    """An ordinary differential equation, whose state is a function of the parameters."""
    system = psf.StateSpaceModel(
        transition=psf.RungeKutta4(
            lambda x, alpha, beta=0.7: [(alpha - beta * x[1]) * x[0], (0.5 * x[0] - 0.8) * x[1]],
            dt=0.1,
        ),
        observation=lambda x: pt.log(x),
        observation_noise=lambda s: [[s**2, 0.0], [0.0, 0.1]],
        initial_mean=lambda start: [start, 0.8],
        initial_cov=np.zeros((2, 2)),
    )
    params = {"alpha": 0.6, "start": 1.5, "s": 0.3}
    observed = [[0.4, -0.1], [0.3, np.nan], [0.5, 0.2], [np.nan, np.nan], [0.1, 0.3]]
    filters = GAUSSIAN | {"BootstrapPF systematic": psf.BootstrapPF(64)}
    fails = {"start": -1.0}
    return Case(system, params, np.array(observed), np.arange(0, 25, 5), filters, fails=fails)


def _rate_and_total() -> Case:
    """A Gaussian system with an accumulator and an input."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, u, a: [a * x[0] + u[0] + q[0], x[1] + x[0] + 0.3 * q[1]],
        process_noise=np.diag([1.0, 0.4]),
        observation=lambda x, u: [x[1] + 0.1 * u[0]],
        observation_noise=lambda r: [[r]],
        initial_mean=[0.5, 0.3],
        initial_cov=np.diag([1.0, 0.2]),
        states=["rate", "total"],
        inputs=["push"],
        accumulators=["total"],
        resets="row",
    )
    steps, push = np.array([0, 3, 4, 8, 11]), np.cos(np.arange(16.0))[:, None]
    observed = np.array([0.1, 1.9, np.nan, 2.5, 3.0])[:, None]
    names = ("EKF", "UKF", "EnKF ensemble", "BootstrapPF systematic", "GuidedPF")
    filters = {name: ALL[name] for name in names}
    return Case(system, {"a": 0.8, "r": 0.2}, observed, steps, filters, push, {"r": -20.0})


def _hopping() -> Case:
    """An oscillator in two wells, and the well it was last in, a carried state."""

    def hop(x, q, u, k):
        well = pt.switch(x[0] > 0.3, 1.0, pt.switch(x[0] < -0.3, -1.0, x[2]))
        force = k * x[0] - x[0] ** 3 - 0.6 * x[1] + 0.2 * x[2] + 0.3 * u[0]
        return [x[0] + 0.2 * x[1] + 0.05 * q[0], x[1] + 0.2 * force + q[1], well]

    system = psf.StateSpaceModel(
        transition=hop,
        process_noise=[[0.3, 0.02], [0.02, 0.05]],
        observation=lambda x, e: [x[0] + (0.3 + 0.05 * x[0]) * e[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.1, 0.0, 1.0],
        initial_cov=np.diag([0.2, 0.1, 0.0]),
        states=["place", "speed", "well"],
        carried=["well"],
        inputs=["force"],
    )
    steps, push = np.array([5, 10, 20, 30]), np.sin(np.arange(50) / 7.0)[:, None]
    filters = ENSEMBLES | KERNELS | PARTICLES
    observed = np.array([0.2, np.nan, 1.1, 0.9])[:, None]
    return Case(system, {"k": 1.3}, observed, steps, filters, push, {"k": np.inf})


def _ring(n_states: int = 20) -> Case:
    """Coupled states, too many to write their covariance out: array code."""
    mix = 0.9 * np.eye(n_states) + 0.05 * np.roll(np.eye(n_states), 1, axis=1)
    seen = np.eye(n_states)[::4]
    system = psf.StateSpaceModel(
        transition=lambda x, q, decay: decay * (mix @ x) + 0.1 * pt.roll(x, 2) ** 2 + q,
        process_noise=0.1 * np.eye(n_states),
        observation=lambda x: seen @ x,
        observation_noise=0.2 * np.eye(len(seen)),
        initial_mean=np.zeros(n_states),
        initial_cov=0.5 * np.eye(n_states),
    )
    observed = np.random.default_rng(40).normal(scale=0.8, size=(4, len(seen)))
    observed[1, 2], observed[2] = np.nan, np.nan
    names = ("EKF", "EnKF ensemble", "BootstrapPF systematic", "GuidedPF")
    filters, steps = {name: ALL[name] for name in names}, np.array([0, 2, 3, 5])
    return Case(system, {"decay": 0.95}, observed, steps, filters, fails={"decay": np.inf})


CASES = {
    "linear": _linear(),
    "double well": _double_well(),
    "oscillator": _oscillator(),
    "counts": _counts(),
    "epidemic": _epidemic(),
    "equation": _equation(),
    "rate and total": _rate_and_total(),
    "hopping": _hopping(),
    "ring": _ring(),
}
# Filters whose states, chains and gradients are stored, with the system of each.
STATES = {
    "linear": ("EKF", "EnKF ensemble", "BootstrapPF systematic", "PFEnKF predictive"),
    "double well": ("GridFilter", "UKF"),
    "counts": ("IPLF", "BootstrapPF sorted"),
    "rate and total": ("EKF",),
    "ring": ("EKF",),
}
GRADIENTS = {
    "linear": tuple(GAUSSIAN),
    "double well": tuple(GAUSSIAN),
    "oscillator": tuple(GAUSSIAN),
    "counts": ("IPLF",),
    "equation": ("EKF",),
    "rate and total": ("EKF", "UKF"),
    "ring": ("EKF",),
}
CHAINS: dict[str, tuple[str, str, dict | None]] = {
    "EKF": ("linear", "EKF", None),
    "EKF in one stage": ("oscillator", "EKF", {"stages": 1}),
    "BootstrapPF": ("double well", "BootstrapPF systematic", None),
    "held noise": ("linear", "EnKF ensemble", {"refresh_noise": False}),
    "correlated noise": (
        "linear", "BootstrapPF sorted", {"stages": 1, "correlation": 0.9},
    ),
    "screened": ("double well", "GuidedPF", {"screen": psf.EKF()}),
    "counts": ("epidemic", "BootstrapPF systematic", None),
}  # fmt: skip
N_DRAWS = 12
TIMED = ("time_per_draw", "perf_counter_diff", "process_time_diff", "perf_counter_start")


def of_likelihoods() -> Evaluations:
    for name, case in CASES.items():
        for who, filter_ in case.filters.items():
            run = partial(psf.run_filter, case.system, filter_, case.params, **case.record, seed=7)
            terms = partial(psf.log_likelihood, case.system, filter_, **case.record)
            yield f"{name} | {who} | terms", partial(terms, case.params, seed=7)
            yield f"{name} | {who} | points", partial(terms, case.points, seed=[3, 4, 5])
            for rows in ("observations", "steps"):
                yield f"{name} | {who} | run at {rows}", partial(run, at=rows)


def of_panels() -> Evaluations:
    for name in ("linear", "double well", "oscillator", "epidemic", "rate and total"):
        case, first = CASES[name], next(iter(CASES[name].params))
        each = case.params | {first: np.array([1.0, 0.97, 0.95]) * case.params[first]}
        for who, filter_ in case.filters.items():
            call = (case.system, filter_, each)
            yield f"{name} | {who} | panel", partial(psf.log_likelihood, *call, **case.panel)
        yield f"{name} | run of a panel", partial(psf.run_filter, *call, **case.panel)


def of_simulations() -> Evaluations:
    for name, case in CASES.items():
        run = partial(psf.simulate, case.system, case.params, random_seed=11)
        one, many = (
            {key: given[key] for key in ("steps", "panel", "inputs") if key in given}
            for given in (case.record, case.panel)
        )
        yield f"{name} | simulate", partial(run, **one)
        yield f"{name} | simulate a panel", partial(run, **many)
        yield f"{name} | simulate without noise", partial(run, **one, noise=False)


def of_gradients() -> Evaluations:
    for name, filters in GRADIENTS.items():
        for who in filters:
            yield f"{name} | {who} | gradient", partial(_value_and_gradient, name, who)
    for name in ("linear", "rate and total"):
        yield f"{name} | EKF | gradient of a panel", partial(_value_and_gradient, name, "EKF", True)


def of_chains() -> Evaluations:
    for what, (name, who, kernel) in CHAINS.items():
        yield f"chain | {what}", partial(_draws, name, who, kernel=kernel)
    yield "chain | panel", partial(_draws, "linear", "BootstrapPF sorted", panel=True)


def of_states() -> Evaluations:
    for name, filters in STATES.items():
        case = CASES[name]
        for who in filters:
            for function in (psf.filtered_states, psf.smoothed_states):
                for rows in ("observations", "steps"):
                    yield (
                        f"{name} | {who} | {function.__name__} at {rows}",
                        partial(_at_draws, function, name, who, at=rows),
                    )
            future = partial(_at_draws, psf.forecast, name, who, n_steps=3, inputs=case.inputs)
            yield f"{name} | {who} | forecast", future
            health = partial(_at_draws, psf.filter_diagnostics, name, who)
            yield f"{name} | {who} | filter_diagnostics", health


def of_ranks() -> Evaluations:
    for name in ("linear", "counts", "hopping"):
        for who in CASES[name].filters:
            if who not in GAUSSIAN | GRID:
                yield f"{name} | {who} | ranks", partial(_second_of_two_ranks, name, who)


def _model(name: str, who: str, panel: bool = False) -> pm.Model:
    case = CASES[name]
    with pm.Model() as model:
        for parameter, value in case.params.items():
            pm.Normal(parameter, value, 0.1 * abs(value))
        record = case.panel if panel else case.record
        psf.StateSpace("d", case.system, case.filters[who], **record)
    return model


def _value_and_gradient(name: str, who: str, panel: bool = False) -> Arrays:
    model = _model(name, who, panel)
    value, gradient = model.compile_logp(), model.compile_dlogp()
    points = [
        {name: np.array(at * factor) for name, at in CASES[name].params.items()}
        for factor in (1.0, 1.02)
    ]
    return {
        "value": np.array([value(point) for point in points]),
        "gradient": np.array([gradient(point) for point in points]),
    }


def _draws(name: str, who: str, panel: bool = False, **settings: Any) -> xr.DataTree:
    with _model(name, who, panel):
        idata = psf.sample_dram(
            N_DRAWS, tune=N_DRAWS, chains=2, cores=1, random_seed=5, progressbar=False,
            compute_convergence_checks=False, **settings,
        )  # fmt: skip
        if not panel:
            psf.filtered_states(idata, n_draws=4, random_seed=6, progressbar=False)
    return idata


def _at_draws(function: Callable, name: str, who: str, **settings: Any) -> xr.DataTree:
    """What a function of states finds at two draws of two chains each, which no sampler made."""
    factors = np.array([[1.0, 1.02], [0.97, 1.01]])
    draws = {key: (("chain", "draw"), at * factors) for key, at in CASES[name].params.items()}
    idata = xr.DataTree.from_dict(
        {"posterior": xr.Dataset(draws, {"chain": [0, 1], "draw": [0, 1]})}
    )
    model = _model(name, who)
    return function(
        idata, model, random_seed=9, progressbar=False, extend_inferencedata=False, **settings
    )


def _second_of_two_ranks(name: str, who: str) -> tuple:
    case = CASES[name]
    evaluate = partial(distributed_evaluator, case.system, case.filters[who])
    theta = np.array([case.params[name] for name in case.system.parameters])
    inputs = np.zeros((0, 0)) if case.inputs is None else case.inputs
    arguments = theta, case.steps, case.observed, inputs, 0.0, 7
    return on_ranks(2, lambda rank: evaluate(rank)(*arguments))[1]


def as_arrays(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """The floating-point arrays of a result, by name."""
    if isinstance(value, xr.DataTree):
        for group in value.subtree:
            yield from as_arrays(
                f"{name} | {group.name}" if group.name else name, group.to_dataset()
            )
    elif isinstance(value, xr.Dataset):
        yield from as_arrays(name, {key: data.to_numpy() for key, data in value.data_vars.items()})
    elif isinstance(value, tuple):
        yield from as_arrays(name, dict(zip(("terms", "health"), value, strict=True)))
    elif isinstance(value, dict):
        for key, array in value.items():
            yield from as_arrays(f"{name} | {key}", array)
    elif value.dtype.kind in "biuf" and name.rpartition(" | ")[2] not in TIMED:
        numbers = np.asarray(value, dtype=np.float64)
        yield name, np.where(np.isnan(numbers), np.nan, numbers)  # NaN has many bits, all the same


def evaluated(part: str) -> Arrays:
    """All arrays of the evaluations whose names contain ``part``."""
    parts = (
        of_likelihoods, of_panels, of_simulations, of_gradients, of_chains, of_states, of_ranks,
    )  # fmt: skip
    found: Arrays = {}
    for evaluations in parts:
        for name, evaluate in evaluations():
            if part in name:
                try:
                    found.update(as_arrays(name, evaluate()))
                except Exception as error:  # the others are of interest all the same
                    print(f"{name}: {error!r}", flush=True)
    return found


def differences(stored: Arrays, found: Arrays, tolerance: float) -> Iterator[str]:
    """A line for each array with another bit, or farther off than a tolerance above 0."""
    for name in sorted(stored.keys() | found.keys()):
        if name not in stored or name not in found:
            yield f"{name}: only {'found' if name in found else 'stored'}"
        elif stored[name].shape != found[name].shape:
            yield f"{name}: shape {found[name].shape}, stored {stored[name].shape}"
        elif stored[name].tobytes() != found[name].tobytes():
            distance = largest_difference(stored[name], found[name])
            if not (distance <= tolerance and tolerance > 0):
                yield f"{name}: {distance:.1e}"


def largest_difference(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference relative to the largest value of a finite pair; inf if one is not."""
    finite = np.isfinite(a) & np.isfinite(b)
    if not np.array_equal(a[~finite], b[~finite], equal_nan=True):
        return np.inf
    size = max(np.abs(a[finite]).max(initial=0.0), np.finfo(float).tiny)
    return float(np.abs(a - b)[finite].max(initial=0.0) / size)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.corpus", description=__doc__)
    parser.add_argument("command", choices=("save", "compare"))
    parser.add_argument("file")
    parser.add_argument("--only", default="", help="evaluations whose names contain this")
    parser.add_argument(
        "--tolerance", type=float, default=0.0, help="relative; 0 asks for equal bits"
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    found = evaluated(options.only)
    if options.command == "save":
        np.savez_compressed(options.file, **found)
        print(f"{len(found)} arrays")
        return 0
    with np.load(options.file) as file:
        stored = {name: file[name] for name in file.files if options.only in name}
    lines = list(differences(stored, found, options.tolerance))
    print("\n".join([*lines, f"{len(lines)} of {len(found)} arrays differ"]))
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
