"""A wing section that pitches and plunges in a wind tunnel: equations, flutter, two records.

The section is mounted on a spring in plunge h (positive down, in m) and on one in pitch alpha (nose
up, in rad), in air that flows at the speed V:

    m h''  + S alpha'' + c_h h'         + k_h h     = -L
    S h''  + I alpha'' + c_alpha alpha' + M(alpha)  = (1/2 + a) b L
    L = rho V^2 b C_L (alpha + h'/V + (1/2 - a) b alpha'/V + w/V),    w a gust, white noise
    M = k_alpha alpha + k_3 alpha^3 + freeplay(alpha; k_f, delta)

per metre of span; the lift is quasi-steady. The numbers are those of the section at Texas A&M
University, a standard example of such limit cycles (J. Ko, A. J. Kurdila, T. W. Strganac, Nonlinear
control of a prototypical wing section with torsional nonlinearity, Journal of Guidance, Control,
and Dynamics 20, 1997). Of its measured pitch spring, a polynomial, we keep the linear and the cubic
term; the freeplay is our own.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import pymc_statespace_filters as psf

MASS, INERTIA = 12.387, 0.065  # kg, kg m^2
HALF_CHORD, AXIS = 0.135, -0.6  # m; the elastic axis, in half chords behind the middle
STATIC_MOMENT = MASS * (0.0873 - HALF_CHORD * (1 + AXIS))  # kg m; centre of mass less axis
K_H, C_H = 2844.4, 27.43  # N/m, N s/m
AIR, LIFT_SLOPE = 1.225, 6.28  # kg/m^3, per rad
INVERSE_MASS = np.linalg.inv([[MASS, STATIC_MOMENT], [STATIC_MOMENT, INERTIA]])

# Against the outer pitch spring the section oscillates at some 10 Hz with little damping. An Euler
# step adds energy to that, and the limit cycle is lost, even at 0.5 ms; the step below keeps it.
DT = 0.0025
DURATION, EVERY = 8.0, 32  # s; steps between observations, three observations per cycle
SPEEDS = (13.0, 15.0)  # m/s, in the first and the second half of a record

# c_alpha is that of the section. A gust of 0.3 m/s with a correlation time of a twentieth of a
# second has about this strength, in m/s per root of a hertz.
COMMON = {"k_alpha": 2.82, "c_alpha": 0.036, "gust": 0.1}
TRUTHS = {
    "cubic": COMMON | {"k_3": 2.82 * 1315.5},
    "freeplay": COMMON | {"k_f": 110.0, "delta": 0.07},
}
# A record must show a limit cycle at both speeds. Every seed gives one: take the first.
SEED = 1


def accelerations(x: Any, speed: Any, moment: Any, c_alpha: Any, gust: Any = 0.0) -> list:
    """Return accelerations of plunge and pitch; `moment` is that of the pitch spring."""
    h, alpha, h_rate, alpha_rate = x
    incidence = alpha + (h_rate + (0.5 - AXIS) * HALF_CHORD * alpha_rate + gust) / speed
    lift = AIR * speed**2 * HALF_CHORD * LIFT_SLOPE * incidence
    force = -lift - K_H * h - C_H * h_rate
    torque = (0.5 + AXIS) * HALF_CHORD * lift - moment - c_alpha * alpha_rate
    return [row[0] * force + row[1] * torque for row in INVERSE_MASS]


def step(x, q, u, k_alpha, c_alpha, gust, k_3=0.0, k_f=0.0, delta=0.0):
    """Return the state one step later: first the rates, then the positions from the new rates."""
    h, alpha, h_rate, alpha_rate = x
    moment = psf.mechanics.cubic(alpha, k_alpha, k_3) + psf.mechanics.freeplay(alpha, k_f, delta)
    a_h, a_alpha = accelerations(x, u[0], moment, c_alpha, gust * q[0] / np.sqrt(DT))
    h_rate, alpha_rate = h_rate + DT * a_h, alpha_rate + DT * a_alpha
    return [h + DT * h_rate, alpha + DT * alpha_rate, h_rate, alpha_rate]


START = [0.01, 0.0, 0.0, 0.0]  # released 1 cm below rest
# Plunge is measured to half a millimetre, pitch to half a degree.
airfoil = psf.StateSpaceModel(
    transition=step,
    process_noise=[[1.0]],
    dt=DT,
    observation=lambda x: [x[0], x[1]],
    observation_noise=np.diag([0.0005, np.deg2rad(0.5)]) ** 2,
    initial_mean=START,
    initial_cov=np.diag([0.001, 0.005, 0.01, 0.05]) ** 2,
    states=["plunge", "pitch", "plunge rate", "pitch rate"],
    observables=["plunge", "pitch"],
    inputs=["speed"],
)


@dataclass(frozen=True)
class Record:
    """Measurements from the wind tunnel.

    Attributes
    ----------
    steps : ndarray, shape (J,)
    speeds : ndarray, shape (steps,)
        Of the air, in m/s, at every step.
    observed : ndarray, shape (J, 2)
    states : ndarray, shape (steps + 1, 4)
        The true motion.
    """

    steps: np.ndarray
    speeds: np.ndarray
    observed: np.ndarray
    states: np.ndarray

    def first_half(self) -> "Record":
        """Return the part of the record at the first speed."""
        n = self.speeds.size // 2
        seen = self.steps <= n
        return Record(self.steps[seen], self.speeds[:n], self.observed[seen], self.states[: n + 1])


def simulated_record(name: str, seed: int = SEED) -> Record:
    """Simulate a record with one of `TRUTHS`."""
    n_steps = round(DURATION / DT)
    steps = np.arange(EVERY, n_steps + 1, EVERY)
    speeds = np.repeat(SPEEDS, n_steps // 2)
    made = psf.simulate(airfoil, TRUTHS[name], steps=steps, inputs=speeds, random_seed=seed)
    return Record(steps, speeds, made["observations"].values, made["states"].values)


def pitch_moment(alpha: Any, p: Any) -> Any:
    """Return the moment of the pitch spring in N m; `p` has numbers, or a posterior (for draws)."""
    gap = np.minimum(np.maximum(alpha, -p.get("delta", 0.0)), p.get("delta", 0.0))
    return p["k_alpha"] * alpha + p.get("k_3", 0.0) * alpha**3 + p.get("k_f", 0.0) * (alpha - gap)


def growth(speed: float, k_alpha: float = COMMON["k_alpha"]) -> complex:
    """Return growth rate (real, 1/s) and angular frequency (imaginary) of the least damped mode.

    It is an eigenvalue of the section with a linear pitch spring.
    """
    columns = [
        [x[2], x[3], *accelerations(x, speed, k_alpha * x[1], COMMON["c_alpha"])] for x in np.eye(4)
    ]
    return max(np.linalg.eigvals(np.transpose(columns)), key=lambda z: (z.real, z.imag))


def flutter_speed() -> float:
    """Return the speed in m/s above which the section does not stay at rest."""
    return brentq(lambda speed: growth(speed).real, 5.0, 20.0)


def limit_cycle(times: np.ndarray, states: np.ndarray) -> tuple[float, float]:
    """Return pitch amplitude in degrees and frequency in Hz, for the second half of a motion.

    NaN if the section has turned over, because there is no cycle then.
    """
    if not np.all(np.abs(states[:, 1]) < np.pi):
        return np.nan, np.nan
    late = times > times[-1] / 2
    pitch, times = states[late, 1], times[late]
    up = np.flatnonzero((pitch[:-1] < 0) & (pitch[1:] >= 0))
    crossings = times[up] - pitch[up] * (times[up + 1] - times[up]) / (pitch[up + 1] - pitch[up])
    turns = np.split(pitch, up)[1:-1]
    amplitude = np.mean([(turn.max() - turn.min()) / 2 for turn in turns])
    return float(np.rad2deg(amplitude)), float(1 / np.diff(crossings).mean())


def motion(name: str, speed: float, how: str, seconds: float = 10.0) -> tuple:
    """Return times and states without gusts: `how` is "exact", "Euler 0.5 ms" or "this step"."""
    p = TRUTHS[name] | {"gust": 0.0}

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        moment = pitch_moment(x[1], p)
        return np.array([x[2], x[3], *accelerations(x, speed, moment, p["c_alpha"])])

    if how == "this step":
        speeds = np.full(round(seconds / DT), speed)
        made = psf.simulate(airfoil, p, steps=[speeds.size], inputs=speeds, random_seed=0)
        return DT * np.arange(speeds.size + 1), made["states"].values
    if how == "exact":
        times = np.arange(0.0, seconds, 0.001)
        span = (0.0, seconds)
        solved = solve_ivp(rates, span, START, "DOP853", times, rtol=1e-7, max_step=0.005)
        return times, solved.y.T
    times, states = np.arange(0.0, seconds, 0.0005), [np.array(START)]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in times[1:]:
            states.append(states[-1] + 0.0005 * rates(0.0, states[-1]))
    return times, np.array(states)


def flutter_table() -> pd.DataFrame:
    """Return eigenvalues of the linear section's least damped motion at rest."""
    speeds = {"flutter speed": flutter_speed()} | {f"record, {v:.0f} m/s": v for v in SPEEDS}
    rows = {
        where: {"V [m/s]": speed, "growth [1/s]": z.real, "frequency [Hz]": z.imag / 2 / np.pi}
        for where, speed in speeds.items()
        for z in [growth(speed)]
    }
    return pd.DataFrame.from_dict(rows, orient="index").round(6).rename_axis("where")


def step_table() -> pd.DataFrame:
    """Compare limit cycles without gusts between the step functions."""
    rows = {}
    for name in TRUTHS:
        for speed in SPEEDS:
            for how in ("exact", "this step", "Euler 0.5 ms"):
                rows[name, speed, how] = limit_cycle(*motion(name, speed, how))
    table = pd.DataFrame(rows, index=["amplitude [deg]", "frequency [Hz]"]).T
    return table.rename_axis(["spring", "V [m/s]", "integrator"])
