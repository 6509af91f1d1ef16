"""The record of lynx and hare, its equation and its posterior: an ordinary differential equation.

Lotka and Volterra's equation takes 1000 Runge-Kutta steps over 20 years; 21 observations of two
species have log-normal errors. Priors are those of B. Carpenter's case study (2018).
"""

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from benchmarks.measure import ROOT

YEARS, HARE, LYNX = np.loadtxt(
    ROOT / "docs" / "tutorials" / "lynx_hare.csv", delimiter=",", skiprows=1, unpack=True
)
TIMES, LOGS = YEARS - YEARS[0], np.log(np.column_stack([HARE, LYNX]))
DT = 0.02
STEPS = np.round(TIMES / DT).astype(np.int64)
NAMES = ("alpha", "beta", "gamma", "delta", "hare", "lynx", "s_hare", "s_lynx")
AT = np.array([0.547, 0.0278, 0.800, 0.0241, 34.0, 5.94, 0.248, 0.251])


def drift(x, alpha, beta, gamma, delta):
    return [(alpha - beta * x[1]) * x[0], (delta * x[0] - gamma) * x[1]]


SYSTEM = psf.StateSpaceModel(
    transition=psf.RungeKutta4(drift, dt=DT),
    observation=lambda x: pt.log(x),
    observation_noise=lambda s_hare, s_lynx: pt.diag(pt.stack([s_hare**2, s_lynx**2])),
    initial_mean=lambda hare, lynx: [hare, lynx],
    initial_cov=np.zeros((2, 2)),
)


def priors() -> dict:
    """The priors of the case study, in the order of `NAMES`."""
    rates = {"alpha": (1.0, 0.5), "beta": (0.05, 0.05), "gamma": (1.0, 0.5), "delta": (0.05, 0.05)}
    found = {name: pm.TruncatedNormal(name, *law, lower=0.0) for name, law in rates.items()}
    for name, law in (("hare", (np.log(10.0), 1.0)), ("lynx", (np.log(10.0), 1.0))):
        found[name] = pm.LogNormal(name, *law)
    return found | {name: pm.LogNormal(name, -1.0, 1.0) for name in ("s_hare", "s_lynx")}


def by_filter() -> pm.Model:
    """The posterior by this package."""
    with pm.Model() as model:
        priors()
        psf.StateSpace("d", SYSTEM, psf.EKF(), steps=STEPS, observed=LOGS)
    return model


def by_pymc_ode() -> pm.Model:
    """The posterior by ``pm.ode``, which calls SciPy's odeint with sensitivities."""

    def rates(x, t, p):
        return [(p[0] - p[1] * x[1]) * x[0], (p[3] * x[0] - p[2]) * x[1]]

    solve = pm.ode.DifferentialEquation(rates, times=TIMES[1:], n_states=2, n_theta=4, t0=0.0)
    with pm.Model() as model:
        p = priors()
        start = pt.stack([p["hare"], p["lynx"]])
        path = solve(y0=start, theta=[p[name] for name in NAMES[:4]])
        logs = pt.log(pt.concatenate([start[None], path]))
        pm.Normal("d", logs, pt.stack([p["s_hare"], p["s_lynx"]]), observed=LOGS)
    return model
