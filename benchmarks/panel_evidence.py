"""Error and time of evidence estimates of a panel whose evidence is known, by its parameters.

Each record has a level of its own about a common one, and its rows are the level with noise: all
data together are normal. The draws are those of ``pm.sample()``, four chains of 2000.
"""

import logging
import time
import warnings
from dataclasses import dataclass

import numpy as np
import pymc as pm
from scipy.stats import multivariate_normal

import pymc_statespace_filters as psf

SIZES, N_ROWS = (12, 30, 100), 3
PRIOR_SD, SPREAD = 2.0, 0.7  # of the common level, and of the levels about it
ESTIMATORS = ("bridge", "importance", "chib_jeliazkov")
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, level: [level + q[0]],
    process_noise=[[0.5]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.5]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


@dataclass(frozen=True)
class PanelEvidence:
    """One estimate: its error and standard error in nats."""

    n_parameters: int
    estimator: str
    error: float
    se: float
    seconds: float


def data_of(n_records: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    levels = rng.normal(1.0, SPREAD, n_records)
    return np.repeat(levels, N_ROWS) + rng.normal(size=n_records * N_ROWS)


def model_of(n_records: int) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, PRIOR_SD)
        pm.Normal("level", mu, SPREAD, shape=n_records)
        psf.StateSpace(
            "d",
            SYSTEM,
            psf.EKF(),
            panel=np.repeat(np.arange(n_records), N_ROWS),
            steps=np.tile(np.arange(1, N_ROWS + 1), n_records),
            observed=data_of(n_records),
        )
    return model


def exact(n_records: int) -> float:
    record = np.repeat(np.arange(n_records), N_ROWS)
    cov = PRIOR_SD**2 + SPREAD**2 * (record[:, None] == record) + np.eye(record.size)
    return float(multivariate_normal(np.zeros(record.size), cov).logpdf(data_of(n_records)))


def panel_evidence() -> list[PanelEvidence]:
    logging.getLogger("pymc").setLevel(logging.CRITICAL)
    found = []
    for n_records in SIZES:
        model, truth = model_of(n_records), exact(n_records)
        with model, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            idata = pm.sample(
                2000, tune=1000, chains=4, cores=1, nuts_sampler="pymc", random_seed=1,
                progressbar=False, quiet=True,
            )  # fmt: skip
        for estimator in ESTIMATORS:
            start = time.perf_counter()
            estimate = psf.estimate_evidence(
                idata, model, estimators=[estimator], random_seed=1, progressbar=False
            )[estimator]
            seconds = time.perf_counter() - start
            error = float(estimate.log_evidence - truth)
            found.append(
                PanelEvidence(n_records + 1, estimator, error, float(estimate.se), seconds)
            )
    return found
