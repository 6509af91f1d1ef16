"""A measles-like epidemic, the same equations as in `benchmarks.peers.pypomp_epidemic`.

Births, infections and the exits of every compartment are counts, and the contact rate has gamma
white noise (as in He, Ionides and King, 2010). 400 weeks of cases, a step a day.
"""

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pymc_statespace_filters as psf

POPULATION, TURNOVER, LATENCY, INFECTIOUS, IMPORTED = 1e6, 0.02 / 365.0, 8.0, 5.0, 2.0
STEPS = np.arange(7, 2801, 7)
TRUTH = {"R0": 17.0, "amplitude": 0.2, "sigma_se": 0.3, "rho": 0.5, "k": 10.0}


def events(x, t, R0, amplitude, sigma_se):
    S, E, I, _ = x  # noqa: E741
    noise = psf.compartments.gamma_white_noise(sigma_se, 1.0)
    season = 1.0 + amplitude * pt.cos(2.0 * np.pi * t / 365.0)
    rate = R0 / INFECTIOUS * season * (I + IMPORTED) / POPULATION * noise
    births = pm.Poisson.dist(TURNOVER * POPULATION)
    infected = psf.compartments.euler_multinomial(S, [rate, TURNOVER], 1.0)
    emerged = psf.compartments.euler_multinomial(E, [1.0 / LATENCY, TURNOVER], 1.0)
    recovered = psf.compartments.euler_multinomial(I, [1.0 / INFECTIOUS, TURNOVER], 1.0)
    return [births, *infected, *emerged, *recovered]


def day(x, q):
    S, E, I, cases = x  # noqa: E741
    births, infected, s_died, emerged, e_died, recovered, i_died = (q[i] for i in range(7))
    return [
        S + births - infected - s_died,
        E + infected - emerged - e_died,
        I + emerged - recovered - i_died,
        cases + recovered,
    ]


EPIDEMIC = psf.StateSpaceModel(
    transition=day,
    process_dist=events,
    observation_dist=lambda x, rho, k: [pm.NegativeBinomial.dist(rho * x[3] + 1e-3, k)],
    initial_mean=[5.5e4, 160.0, 100.0, 0.0],
    initial_cov=np.zeros((4, 4)),
    accumulators=["cases"],
    states=["S", "E", "I", "cases"],
    observables=["reports"],
)


def record() -> np.ndarray:
    """Reports of 400 weeks."""
    run = psf.simulate(EPIDEMIC, TRUTH, steps=STEPS, random_seed=1)
    return run["observations"].to_numpy()
