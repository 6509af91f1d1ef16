"""Heat dynamics of a building: a linear stochastic differential equation by maximum likelihood.

The record is "armadillo" of the Python package pySIP (L. Raillon and others): outdoor temperature,
power of the heating and indoor temperature of a building, every half hour for five days. The model
has two temperatures, of the envelope and of the room, between two resistances; the envelope's has
noise. Inputs are linear between samples. pySIP's documentation (``fit_frequentist``, 2023) prints
the maximum of the likelihood, found by BFGS.

Time is in days, so capacities are in watt days per kelvin. The last row of the record is left out
and the sun is not in the model, as there.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
from comparison import Comparison, Study, cpu_seconds, table

import pymc_statespace_filters as psf

RECORD = pd.read_csv(Path(__file__).parent / "data" / "armadillo.csv")
DT = 1 / 48
INPUTS = RECORD[["T_ext", "P_hea"]].to_numpy()

# As printed: estimate, its standard error, and the slope at which BFGS stopped.
STORED = {
    "Ro": (0.017593, 0.000927, 0.000022),
    "Ri": (0.001984, 0.000075, 0.000049),
    "Cw": (169.597112, 7.662583, 0.000023),
    "Ci": (18.946350, 0.771580, 0.000022),
    "sigma_w": (0.521344, 0.046986, 0.000007),
    "sigma_v": (0.034325, 0.002333, 0.000029),
    "start": (26.594539, 0.130517, 0.000011),
}
LOG_LIKELIHOOD = 331.057569


def drift(x, u, Ro, Ri, Cw, Ci):
    wall, room, outside, heating = x
    to_room = (wall - room) / Ri
    # A state whose rate is known is an input that is linear between samples.
    return [((outside - wall) / Ro - to_room) / Cw, (to_room + heating) / Ci, u[0], u[1]]


building = psf.StateSpaceModel(
    transition=psf.LocalLinearization(
        drift, lambda sigma_w: [[sigma_w], [0.0], [0.0], [0.0]], dt=DT
    ),
    observation=lambda x: [x[1]],
    observation_noise=lambda sigma_v: [[sigma_v**2]],
    initial_mean=lambda start: [start, 26.7, *INPUTS[0]],
    initial_cov=np.diag([0.1**2, 0.1**2, 0.0, 0.0]),
    inputs=["rate of T_ext", "rate of P_hea"],
)


def study() -> Study:
    with pm.Model():  # priors say where to look
        pm.LogNormal("Ro", np.log(0.01), 1.0)
        pm.LogNormal("Ri", np.log(0.001), 1.0)
        pm.LogNormal("Cw", np.log(100.0), 1.0)
        pm.LogNormal("Ci", np.log(10.0), 1.0)
        pm.LogNormal("sigma_w", np.log(0.3), 1.0)
        pm.LogNormal("sigma_v", np.log(0.01), 1.0)
        pm.Normal("start", 25.0, 7.0)
        psf.StateSpace(
            "d",
            building,
            psf.EKF(),
            steps=np.arange(len(RECORD)),
            inputs=np.diff(INPUTS, axis=0) / DT,
            observed=RECORD.T_int,
        )
        with cpu_seconds() as seconds:
            found = psf.maximum_likelihood(random_seed=1)
    # pySIP keeps times to 1e-9, which moves the log-likelihood by some millionths.
    comparisons = [
        Comparison("log-likelihood", LOG_LIKELIHOOD, 5e-6, found.log_likelihood, by_chance=False)
    ]
    ratios = []
    for name, (estimate, error, slope) in STORED.items():
        # The scale of the logarithm, or of the start; a slope moves the maximum by error^2 slope.
        scale = 7.0 if name == "start" else estimate
        left = np.hypot(error**2 * slope / scale, 0.5e-6 / 3**0.5)
        ours = float(found.estimate[name])
        what = f"estimate of {name}"
        comparisons.append(Comparison(what, estimate, left, ours, by_chance=False))
        ratios.append(error / float(found.standard_errors[name]))
    return Study(
        "building, 232 half hours",
        "pySIP, its documentation (2023)",
        comparisons,
        seconds[0],
        "The errors are those of rounding and of the slope at which their search stopped. Their "
        f"standard errors, by BFGS, are {min(ratios):.2f} to {max(ratios):.2f} of ours, by second "
        "differences.",
    )


if __name__ == "__main__":
    print(table([study()]))
