"""Acceptance and time of chains on a panel with particles, by the number of its records.

Records of the double well, each with its own linear stiffness and of 50 observations, with
`BootstrapPF(100)`. The chains move the records one by one, or all parameters together as
``pm.sample(step=psf.DRAM())`` does. Times are wall seconds of one chain on one core.
"""

import logging
from dataclasses import dataclass

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH

SIZES = (2, 10, 30, 100)
N_OBSERVATIONS, STEPS_BETWEEN = 50, 20
TUNE, DRAWS = 1000, 1000
MOST_TOGETHER = 30  # records of the chains that hardly move


@dataclass(frozen=True)
class PanelChain:
    """One line of the table."""

    moves: str
    n_records: int
    accepted: float  # part of the iterations in which the first record moved
    seconds: float  # of 1000 iterations


def model_of(n_records: int) -> pm.Model:
    steps = STEPS_BETWEEN * np.arange(N_OBSERVATIONS)
    stiffness = np.random.default_rng(1).normal(4.0, 0.5, max(SIZES))[:n_records]
    records = [
        psf.simulate(DOUBLE_WELL, DOUBLE_WELL_TRUTH | {"alpha": a}, steps=steps, random_seed=i)
        for i, a in enumerate(stiffness)
    ]
    with pm.Model() as model:
        alpha = pm.Normal("alpha", 4.0, 1.0, shape=n_records)
        psf.StateSpace(
            "d",
            DOUBLE_WELL,
            psf.BootstrapPF(100),
            panel=np.repeat(np.arange(n_records), N_OBSERVATIONS),
            steps=np.tile(steps, n_records),
            observed=np.concatenate([record["observations"].values for record in records]),
            params=DOUBLE_WELL_TRUTH | {"alpha": alpha},
        )
    return model


def chain_of(model: pm.Model, moves: str) -> PanelChain:
    options = {
        "draws": DRAWS,
        "tune": TUNE,
        "chains": 1,
        "cores": 1,
        "random_seed": 3,
        "progressbar": False,
        "compute_convergence_checks": False,
    }
    with model:
        if moves == "one by one":
            idata = psf.sample_dram(**options)
        else:
            idata = pm.sample(step=psf.DRAM(), **options)
    first = idata["posterior"]["alpha"].values[0, :, 0]
    seconds = idata["posterior"].attrs["sampling_time"] * 1000 / (TUNE + DRAWS)
    n_records = idata["posterior"]["alpha"].shape[-1]
    return PanelChain(moves, n_records, float(np.mean(np.diff(first) != 0.0)), seconds)


def panel_sampling() -> list[PanelChain]:
    logging.getLogger("pymc").setLevel(logging.CRITICAL)  # of chains that do not move
    found = []
    for n_records in SIZES:
        model = model_of(n_records)
        found.append(chain_of(model, "one by one"))
        if n_records <= MOST_TOGETHER:
            found.append(chain_of(model, "together"))
    return found
