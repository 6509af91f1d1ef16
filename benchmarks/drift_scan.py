"""Whether the p-values of `drift_scan` are uniform, and its power beside that of the exact test.

Records of 100 rows of a linear system with a forced gain, of which the `EKF` has the exact
likelihood, and 99 simulated data sets for each. The exact test takes the derivative of the
likelihood of the system whose gain walks at random, by the square of its strength at zero.

``python -m benchmarks.drift_scan 60`` prints, of 60 records at each strength, how many have a
p-value of the gain alone of at most 5 %, by the scan and by the exact test; strength zero has five
times as many records. It takes 2 CPU min.

Of 60 records at strengths 0.05, 0.1 and 0.2: 36, 51 and 58 by the scan, 34, 52 and 59 by the exact
test. Of 800 constant records by the scan alone: 31 of the factor of the state, 37 of the gain, 44
of the variance of the sensor, where 40 are expected.
"""

import sys

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from pymc_statespace_filters.diagnostics.constancy.estimation import expected_information, modes
from pymc_statespace_filters.diagnostics.constancy.statistics import ConstancyTest, constancy
from pymc_statespace_filters.diagnostics.constancy.table import TimeAxis
from pymc_statespace_filters.pymc_model.term_scores import ScoredVariable
from tests.systems import driven, driven_by_wandering_gain

N_ROWS, N_SIMULATED = 100, 99
FORCE = np.random.default_rng(0).normal(size=(N_ROWS, 1))
STEPS = np.arange(1, N_ROWS + 1)
TRUE = {"a": 0.7, "gain": 1.0, "sigma": 0.3}
AT_TRUE = np.array([0.7, np.log(0.3), 1.0])  # of the free variables, unconstrained
WANDERING, SMALL, LEVEL = driven_by_wandering_gain(), 5e-3, 0.05


def _simulated(random_seed, strength):
    values = TRUE | {"strength": strength}
    run = psf.simulate(WANDERING, values, steps=STEPS, inputs=FORCE, random_seed=random_seed)
    return run["observations"].values


def _variable(observed):
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.3)
        pm.HalfNormal("sigma", 1.0)
        pm.Normal("gain", 0, 2)
        psf.StateSpace("d", driven(), psf.EKF(), steps=STEPS, inputs=FORCE, observed=observed)
    variable = ScoredVariable(model, "d")
    return variable, TimeAxis.of(model, variable).durations


def _derivative(values, observed):
    """The exact one, of the likelihood of a data set at its mode."""
    params = {name: np.repeat(values[name], 2) for name in TRUE}
    params["strength"] = np.array([0.0, SMALL])
    terms = psf.log_likelihood(
        WANDERING, psf.EKF(), params, observed, steps=STEPS, inputs=FORCE
    ).sum(axis=-1)
    return (terms[1] - terms[0]) / SMALL**2


def _p_values(variable, durations, seed):
    """Of the gain, by the scan and by the exact test."""
    test = ConstancyTest(variable, durations, AT_TRUE)
    simulated = test._possible(N_SIMULATED, np.random.default_rng(seed))
    at_mode = np.repeat(test.mode.x, len(simulated), axis=0)
    information = expected_information(variable.scores(at_mode, simulated, test._scale))
    data = np.concatenate([variable.observed[None], simulated])
    start = np.repeat(test.mode.x, len(data), axis=0)
    found = modes(variable, start, data, test._scale, information)
    gain = variable.labels.index("gain")
    scanned = constancy(found.scores, durations, variable.of_rows).statistic[:, gain]
    theta = variable.theta(found.x).reshape(len(data), -1, len(variable.labels))[:, 0]
    exact = [
        _derivative(dict(zip(variable.labels, values, strict=True)), observed)
        for values, observed in zip(theta, data, strict=True)
    ]
    return [(np.array(one) >= one[0]).mean() for one in (scanned, exact)]


def main(n_records):
    """Print how many records are rejected."""
    variable, durations = _variable(_simulated(1, 0.0))
    for strength in (0.0, 0.05, 0.1, 0.2):
        found, n = [], n_records * (5 if strength == 0 else 1)
        for i in range(n):
            variable.observed = _simulated(70_000 + i, strength)
            found.append(_p_values(variable, durations, i))
        scan, exact = (np.array(found) <= LEVEL + 1e-9).sum(axis=0)
        print(f"strength {strength}: of {n} records {scan} by the scan, {exact} by the exact test")


if __name__ == "__main__":
    main(int(sys.argv[1]))
