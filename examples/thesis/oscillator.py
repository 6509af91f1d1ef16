"""A mass on a damped spring with three nonlinearities, and its records (thesis, Section 5.3).

A known force drives the mass, and its displacement u is measured now and then:

    m u'' + c u' + k_l u + k_nl u^3 + freeplay(u) + hysteresis(u, u') = T cos(omega t) + sigma W(t)

Two studies share this file: the parameters of this equation (`mass_spring_damper.py`), and which of
the three nonlinearities a record shows (`model_choice.py`). A force whose parameters are not given
is absent: their defaults are zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

import pymc_statespace_filters as psf

DT, DURATION, MASS, OMEGA = 0.01, 30.0, 1.0, 1.5

# The parameters of each nonlinearity; the LINEAR ones are always present.
LINEAR = ("k_l", "c", "sigma")
NONLINEARITIES = {
    "cubic": ("k_nl",),
    "freeplay": ("k_f", "delta_f"),
    "hysteresis": ("k_h", "a_h", "delta_h"),
}

# The true values. The thesis does not say where the plateaus of the hysteresis begin, a_h: taken
# well away from delta_f, so that a record can distinguish the two kinks.
TRUTH = {
    "k_l": 1.0,
    "c": 0.3,
    "sigma": 0.0,
    "k_nl": 1.0,
    "k_f": 1.0,
    "delta_f": 0.2,
    "k_h": 1.0,
    "a_h": 0.5,
    "delta_h": 1.5,
}


def oscillator(*, memory: bool = False, width: float | None = None) -> psf.StateSpaceModel:
    """Return the system; displacement in m, velocity in m/s, with `memory` the hysteresis branch.

    The force T cos(omega t) is an input, and the variance Gamma of the measurements a parameter, so
    that all cases are one system. Without `memory` the sign of the velocity selects the branch.
    `width` rounds the kinks (`psf.mechanics.freeplay`).
    """

    def transition(x, q, u, k_l, c, sigma, k_nl=0, k_f=0, delta_f=0, k_h=0, a_h=0, delta_h=0):
        """One Euler step, Eq. 5.25."""
        z, velocity = x[0], x[1]
        branch = x[2] if memory else velocity
        force = (
            psf.mechanics.cubic(z, k_l, k_nl)
            + psf.mechanics.freeplay(z, k_f, delta_f, width=width)
            + psf.mechanics.hysteresis(z, branch, k_h, a_h, delta_h, width=width)
            + c * velocity
        )
        moved = z + DT * velocity
        kicked = velocity + (DT * (u[0] - force) + np.sqrt(DT) * sigma * q[0]) / MASS
        if not memory:
            return [moved, kicked]
        return [moved, kicked, psf.mechanics.hysteresis_branch(moved, branch, a_h, delta_h)]

    n_branches = int(memory)
    return psf.StateSpaceModel(
        transition=transition,
        process_noise=[[1.0]],
        dt=DT,
        observation=lambda x: [x[0]],
        observation_noise=lambda Gamma: [[Gamma]],
        # The thesis does not say how the motion starts either: released at 1 m, known to a tenth of
        # a metre and metre per second. Without spread an ensemble would be a single point at sigma
        # = 0.
        initial_mean=lambda start=1.0: [start, 0.0] + [1.0] * n_branches,
        initial_cov=np.diag([0.01, 0.01] + [0.0] * n_branches),
        states=["displacement", "velocity"] + ["branch"] * n_branches,
        carried=["branch"] * n_branches,
        observables=["measured"],
        inputs=["force"],
    )


@dataclass(frozen=True)
class Case:
    """A record of 30 seconds: how it is simulated, and the model of it.

    Attributes
    ----------
    name : str
    T : float
        Amplitude of the driving force, in N.
    Gamma : float
        Variance of the measurements, in m^2.
    every : int
        Steps from one measurement to the next.
    seed : int
        Of the record. No other has been tried.
    memory : bool
        Whether the hysteresis keeps its branch inside the loop.
    shared : bool
        Whether the three stiffnesses k_l, k_f, k_h are known to be equal.
    start : float
        Displacement at which the mass is released, in m, known to a tenth of it.
    """

    name: str
    T: float
    Gamma: float
    every: int
    seed: int
    memory: bool = False
    shared: bool = False
    start: float = 1.0

    @property
    def slug(self) -> str:
        """The name in a form for file names."""
        return "_".join("".join(c if c.isalnum() else " " for c in self.name).split())

    @property
    def known(self) -> dict[str, float]:
        """Parameters of the system that are not estimated."""
        return {"Gamma": self.Gamma, "start": self.start}

    @property
    def steps(self) -> np.ndarray:
        """Steps of the measurements; the first is at the start."""
        return np.arange(0, round(DURATION / DT) + 1, self.every)

    @property
    def inputs(self) -> np.ndarray:
        """The driving force at every step, in N, shape (steps, 1)."""
        times = DT * np.arange(round(DURATION / DT) + 1)
        return self.T * np.cos(OMEGA * times)[:, None]

    def record(self) -> xr.Dataset:
        """Motion and measurements, as `psf.simulate` returns them."""
        return psf.simulate(
            oscillator(memory=self.memory),
            TRUTH | self.known,
            steps=self.steps,
            inputs=self.inputs,
            random_seed=self.seed,
        )

    def observe(self, filter: psf.EnKF | psf.PFEnKF | psf.EKF, width: float | None = None) -> None:
        """Add the record to the PyMC model of the context, which has the parameters."""
        psf.StateSpace(
            "d",
            oscillator(memory=self.memory, width=width),
            filter,
            params=self.known,
            steps=self.steps,
            inputs=self.inputs,
            observed=self.record()["observations"].values,
        )


# Case 1 as printed sticks: 0.5 N do not overcome the friction of a hysteresis without memory, of
# k_h delta_h / 2 = 0.75 N. So it appears here twice, with memory, and with the force of case 2. The
# numbers of measurements are not printed either, except for the second record of case 2.
CASES = {
    case.name: case
    for case in (
        Case("case 1, memory", 0.5, 0.05, 30, seed=531, memory=True, shared=True),
        Case("case 1, T = 3", 3.0, 0.05, 30, seed=531, shared=True),
        Case("case 2, dense", 3.0, 0.005, 10, seed=532),
        Case("case 2, sparse", 3.0, 0.005, 30, seed=532),
        Case("case 3", 3.0, 0.02, 30, seed=533),
    )
}


def restoring_force(
    u: np.ndarray,
    direction: float,
    parameters: Mapping[str, Any],
    *,
    width: float | None = None,
) -> np.ndarray:
    """Return the springs' force at displacements `u`, on the way up (`direction` 1) or down (-1).

    `parameters` are numbers or draws, all of one shape S, such as a posterior; missing ones are
    absent forces. The result has shape S + (u.size,), in N.
    """
    p = {name: np.asarray(parameters.get(name, 0.0))[..., None] for name in TRUTH}
    force = (
        psf.mechanics.cubic(u, p["k_l"], p["k_nl"])
        + psf.mechanics.freeplay(u, p["k_f"], p["delta_f"], width=width)
        + psf.mechanics.hysteresis(u, direction, p["k_h"], p["a_h"], p["delta_h"], width=width)
    )
    return force.eval(mode="FAST_COMPILE")
