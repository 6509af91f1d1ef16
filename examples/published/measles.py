"""Measles in ten towns of England and Wales: weekly cases, 1950 to 1963, and two sources of noise.

He, Ionides and King, "Plug-and-play inference for disease dynamics: measles in large and small
populations as a case study", Journal of the Royal Society Interface 7 (2010), fit a stochastic
model of susceptible, exposed and infectious people to twenty towns: the ten largest and ten
smaller ones. Their parameters, to three digits, and the log-likelihoods with their standard errors,
by particle filters, are in pypomp 1.1, with the records and with the yearly numbers of people and
births. Five of the large towns have doubtful weeks there, which were corrected in 2010, so the ten
smaller towns are here. Not stated with the parameters, and taken from pypomp's ``model_001``: the
transmission rate as a function of R0, and smoothing splines through the yearly numbers.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds, table
from scipy.interpolate import make_smoothing_spline

import pymc_statespace_filters as psf

DATA = Path(__file__).parent / "data"
CASES = pd.read_csv(DATA / "measles.csv", index_col="day")  # days after 1 January 1950
PEOPLE = pd.read_csv(DATA / "measles_people.csv").set_index("town")
FITS = pd.read_csv(DATA / "measles_fits.csv", index_col="town")
DT = 1 / 365.25  # years: a day
N_RUNS = 8


def noise(x, u, R0, sigma, gamma, mu, alpha, iota, sigmaSE, cohort, amplitude):
    susceptible, exposed, infectious, _ = x
    people, births, in_term, school_starts = u
    # A part of the cohort enters on one day.
    entering = (1.0 - cohort) * births * DT + school_starts * cohort * births
    season = pt.switch(in_term > 0.5, 1.0 + amplitude * 0.2411 / 0.7589, 1.0 - amplitude)
    transmission = R0 * season * (1.0 - pt.exp(-(gamma + mu) * DT)) / DT
    force = transmission * (infectious + iota) ** alpha / people
    return [
        pm.Poisson.dist(entering),
        *psf.compartments.euler_multinomial(
            susceptible, [force * psf.compartments.gamma_white_noise(sigmaSE, DT), mu], DT
        ),
        *psf.compartments.euler_multinomial(exposed, [sigma, mu], DT),
        *psf.compartments.euler_multinomial(infectious, [gamma, mu], DT),
    ]


def step(x, q):
    susceptible, exposed, infectious, recovered_this_week = x
    enter, infected, dead_s, fall_ill, dead_e, recover, dead_i = q
    return [
        susceptible + enter - infected - dead_s,
        exposed + infected - fall_ill - dead_e,
        infectious + fall_ill - recover - dead_i,
        recovered_this_week + recover,
    ]


def log_density(d, x, rho, psi):
    """A normal distribution of whole numbers, rounded; zero and below are zero."""
    mean = rho * x[3]
    sd = pt.sqrt(mean * (1.0 - rho + psi**2 * mean)) + 1e-18
    below = [0.5 * pt.erfc((mean - edge) / sd / np.sqrt(2.0)) for edge in (d[0] + 0.5, d[0] - 0.5)]
    return pt.log(below[0] - pt.switch(d[0] > 0.0, below[1], 0.0) + 1e-18)


def covariates(town: str, steps: int, first_day: int) -> np.ndarray:
    """People, births four years before, whether school is in session and whether it starts."""
    of_town, time = PEOPLE.loc[town], 1950.0 + (first_day + np.arange(steps)) * DT
    year = of_town.year.to_numpy(float)
    people = make_smoothing_spline(year, of_town.people.to_numpy(float))(time)
    births = make_smoothing_spline(year + 0.5, of_town.births.to_numpy(float))(time - 4.0)
    day = (time % 1.0) * 365.25
    terms = ((7, 100), (115, 199), (252, 300), (308, 356))
    in_term = np.any([(start <= day) & (day <= end) for start, end in terms], axis=0)
    school_starts = np.abs(time % 1.0 - 251 / 365) < 0.5 * DT
    return np.column_stack([people, births, in_term, school_starts])


def log_likelihood(town: str) -> tuple[float, float]:
    """Logarithm of the mean likelihood of all runs, and its standard error."""
    days, fit = CASES.index.to_numpy(), FITS.loc[town]
    first_day = days[0] - 7
    u = covariates(town, days[-1] - first_day, first_day)
    share = fit[["S_0", "E_0", "I_0"]] / fit[["S_0", "E_0", "I_0", "R_0"]].sum()
    seir = psf.StateSpaceModel(
        transition=step,
        process_dist=noise,
        dt=DT,
        observation_logp=log_density,
        initial_mean=[*np.rint(u[0, 0] * share), 0.0],
        initial_cov=np.zeros((4, 4)),
        states=["susceptible", "exposed", "infectious", "recovered_this_week"],
        accumulators=("recovered_this_week",),
        resets="row",
        inputs=["people", "births", "in_term", "school_starts"],
    )
    given = {name: fit[name] for name in seir.parameters}
    # Large outbreaks are harder to follow; the error of a mean needs runs that differ by few nats.
    n_particles = 4000 if u[0, 0] < 50_000 else 10_000
    runs = psf.log_likelihood(
        seir,
        psf.BootstrapPF(n_particles),
        given,
        CASES[town].to_numpy(float),
        steps=days - first_day,
        inputs=u,
        seed=np.arange(N_RUNS),
    ).sum(axis=-1)
    ratios = np.exp(runs - runs.max())
    error = ratios.std(ddof=1) / ratios.mean() / N_RUNS**0.5
    return runs.max() + np.log(ratios.mean()), error


def study() -> Study:
    with cpu_seconds() as seconds:
        ours = {town: log_likelihood(town) for town in FITS.index}
    return Study(
        "measles, 730 weeks of ten towns",
        "He, Ionides and King, Journal of the Royal Society Interface 7 (2010); parameters, "
        "log-likelihoods and records as in the Python package pypomp 1.1",
        [
            Comparison(f"log-likelihood, {town}", fit.loglik, fit.loglik_sd, *ours[town])
            for town, fit in FITS.iterrows()
        ],
        seconds[0],
        f"Ours is the logarithm of the mean of {N_RUNS} runs of 4000 particles, or of 10 000 in "
        "towns of more than 50 000 people.",
    )


if __name__ == "__main__":
    print(table([study()]))
