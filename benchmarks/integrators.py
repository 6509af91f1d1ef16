"""Error and cost of integrators, on the same Brownian paths as a reference with a fine step.

The double well, a lightly damped Duffing oscillator and a stiff relaxation oscillator (van der
Pol), each with noise. The error is that of the first state at the end, root mean square over paths.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system

REFERENCE = "RungeKutta4"


@dataclass(frozen=True)
class Trial:
    """Root mean square error at the end, and CPU nanoseconds of a member per unit of time."""

    system: str
    integrator: str
    dt: float
    error: float
    nanoseconds: float


@dataclass(frozen=True)
class Example:
    """An equation, its start and end, the steps that are tried, and that of the reference."""

    drift: Callable
    diffusion: list[list[float]]
    start: list[float]
    end: float
    steps: tuple[float, ...]
    finest: float
    n_paths: int


def double_well(x):
    return [4.0 * x[0] - 4.0 * x[0] ** 3]


def duffing(x):
    return [x[1], -0.02 * x[1] - x[0] - 0.5 * x[0] ** 3]


def van_der_pol(x):
    return [x[1], 20.0 * (1.0 - x[0] ** 2) * x[1] - x[0]]


EXAMPLES = {
    "double well": Example(
        double_well, [[0.6]], [1.0], 2.0, (0.2, 0.1, 0.05, 0.0125), 0.0125 / 16, 1024
    ),
    "Duffing oscillator, lightly damped": Example(
        duffing, [[0.0], [0.05]], [1.0, 0.0], 20.0, (0.4, 0.2, 0.1, 0.025), 0.025 / 16, 256
    ),
    "van der Pol oscillator, stiff": Example(
        van_der_pol, [[0.0], [0.1]], [2.0, 0.0], 20.0, (0.1, 0.05, 0.02, 0.005), 0.005 / 8, 64
    ),
}  # fmt: skip


def compiled(name: str, example: Example, dt: float):
    settings = {"velocities": [1]} if name == "SemiImplicitEuler" else {}
    n = len(example.start)
    model = psf.StateSpaceModel(
        transition=getattr(psf, name)(example.drift, example.diffusion, dt=dt, **settings),
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=example.start,
        initial_cov=np.zeros((n, n)),
    )
    return compile_system(model)


def ends(name: str, example: Example, dt: float, fine: np.ndarray) -> tuple[np.ndarray, float]:
    """The first state at the end, and CPU seconds; ``fine`` are the normals of finest steps."""
    system = compiled(name, example, dt)
    ratio = round(dt / example.finest)
    normals = of_steps(fine, ratio, system.m)
    X = np.repeat(np.array(example.start)[:, None], example.n_paths, axis=1)
    c, inputs = system.prepare.function(np.zeros(0)), np.zeros((len(normals), 0))
    move = system.propagate.function
    move(c, inputs, 0, 0.0, normals[0], X.copy())  # compiles
    seconds = np.empty(len(normals))
    for k, z in enumerate(normals):
        start = time.process_time()
        move(c, inputs, k, k * dt, z, X)
        seconds[k] = time.process_time() - start
    return X[0], float(np.median(seconds)) * len(normals)


def of_steps(fine: np.ndarray, ratio: int, m: int) -> np.ndarray:
    """Normals of long steps on the same Brownian path.

    Where a step takes two, it is the velocity that has the noise: the first normal is that of the
    position, the integral of the path, and the second that of what is left of the increment.
    """
    inside = fine.reshape(-1, ratio, 1, fine.shape[-1])
    increment = inside.sum(axis=1) / np.sqrt(ratio)
    if m == 1:
        return increment
    left = 1.0 - (np.arange(ratio) + 0.5) / ratio
    integral = np.sqrt(3.0) * np.einsum("kimn,i->kmn", inside, left) / np.sqrt(ratio)
    return np.concatenate([integral, 2.0 * increment - np.sqrt(3.0) * integral], axis=1)


def integrators() -> Iterator[Trial]:
    """Measure every integrator with every step."""
    for label, example in EXAMPLES.items():
        rng = np.random.default_rng(0)
        fine = rng.normal(size=(round(example.end / example.finest), 1, example.n_paths))
        reference, _ = ends(REFERENCE, example, example.finest, fine)
        names = ["EulerMaruyama", "RungeKutta4", "LocalLinearization"]
        names += ["SemiImplicitEuler"] if len(example.start) > 1 else []
        for name in names:
            for dt in example.steps:
                found, seconds = ends(name, example, dt, fine)
                with np.errstate(all="ignore"):
                    error = float(np.sqrt(np.mean((found - reference) ** 2)))
                per_time = 1e9 * seconds / example.n_paths / example.end
                yield Trial(label, name, dt, error, per_time)


def table(rows: list[Trial]) -> str:
    """The table of the guide: for each system a line per integrator and step."""
    text = []
    for label in dict.fromkeys(row.system for row in rows):
        group = [row for row in rows if row.system == label]
        names = list(dict.fromkeys(row.integrator for row in group))
        steps = sorted({row.dt for row in group}, reverse=True)
        found = {(row.integrator, row.dt): row for row in group}
        head = ["step", *(f"`{name}`" for name in names)]
        lines = [[f"{dt:g}", *(_cell(found[name, dt]) for name in names)] for dt in steps]
        parts = [head, ["---"] * len(head), *lines]
        listed = "\n".join(f"| {' | '.join(part)} |" for part in parts)
        text.append(f"**{label[0].upper()}{label[1:]}**\n\n{listed}\n")
    return "\n".join(text)


def _cell(row: Trial) -> str:
    if not row.error < 10.0:
        return "diverges"
    return f"{row.error:.2g} ({row.nanoseconds:.0f} ns)"
