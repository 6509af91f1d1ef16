"""Ranks of parameters in posteriors of a population whose noise is proportional to its state.

Parameters are drawn from the prior, and data of 20 people from these: the amount of a drug in one
compartment after a bolus, ``dA = -CL / V A dt + sigma A dW``, by steps of half an hour in NumPy, so
that the simulator of the package has no part in it. Each person has a clearance of his own. The
rank of the true sigma and of the true typical clearance among draws of a right posterior is
uniform. The likelihood of `GuidedPF` is unbiased; `EKF` replaces the skewed law of the amount by a
normal one. It is also shown with a prior of larger noise, where chains with particles take too
long. Run it with ``python -m benchmarks.process_noise_ranks`` from the root of the repository;
another number of data sets than 40 may be given, and the name of a single study.

Ranks are tested by the band of their ECDF, which has an exact error rate. Each study has two tests,
of sigma and of the clearance, each at 0.005: one of them fails for a right filter in one study of a
hundred.
"""

import sys
import time
import warnings
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytensor

import pymc_statespace_filters as psf
from tests.sampling.rank_uniformity import ecdf_p, histogram

TABLE = Path(__file__).parents[1] / "docs" / "_static" / "process_noise_ranks.inc"
# The filter, and the median of the prior of sigma.
STUDIES: dict[str, tuple[Any, float]] = {
    "GuidedPF(50)": (psf.GuidedPF(50), 0.15),
    "EKF()": (psf.EKF(), 0.15),
    "EKF(), larger noise": (psf.EKF(), 0.4),
}
NAMES = ("sigma", "CL")
PEOPLE, DT, DOSE, VOLUME, SD, BETWEEN = 20, 0.5, 100.0, 20.0, 0.3, 0.3
TIMES = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0])  # hours
N_KEPT, N_BINS = 31, 8  # draws among which a rank is taken; bins of the 32 ranks in the table
CHAINS, TUNE = 2, 300
# Chains are made longer until they have as many effective draws as are kept.
LENGTHS = (400, 1600, 6400)

system = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x, CL: [-CL / VOLUME * x[0]], lambda x, sigma: [[sigma * x[0]]], dt=DT
    ),
    observation=lambda x: [x[0] / VOLUME],
    observation_noise=[[SD**2]],
    initial_mean=[0.0],
    initial_cov=[[0.0]],
    event=lambda x, dose: [x[0] + dose],
    events=["dose"],
    states=["amount"],
    observables=["concentration"],
)


def drawn(number: int, median: float) -> tuple[dict[str, float], np.ndarray]:
    """Parameters from the prior, and the concentrations of all people, one person after another."""
    rng = np.random.default_rng([7, number])
    truth = {
        "sigma": median * np.exp(0.3 * rng.standard_normal()),
        "CL": 2.0 * np.exp(0.3 * rng.standard_normal()),
    }
    clearance = truth["CL"] * np.exp(BETWEEN * rng.standard_normal(PEOPLE))
    amount, seen = np.full(PEOPLE, DOSE), []
    for step in range(1, round(TIMES[-1] / DT) + 1):
        noise = truth["sigma"] * np.sqrt(DT) * rng.standard_normal(PEOPLE)
        amount = amount * (1.0 - clearance / VOLUME * DT + noise)
        if step * DT in TIMES:
            seen.append(amount / VOLUME + SD * rng.standard_normal(PEOPLE))
    return truth, np.stack(seen, axis=1).reshape(-1, 1)


def model_of(filter: Any, median: float, record: Any) -> pm.Model:
    with pm.Model() as model:
        clearance = pm.LogNormal("CL", np.log(2.0), 0.3)
        of_people = pm.LogNormal("CL of people", pm.math.log(clearance), BETWEEN, shape=PEOPLE)
        pm.LogNormal("sigma", np.log(median), 0.3)
        psf.StateSpace(
            "d",
            system,
            filter,
            params={"CL": of_people},
            panel=np.repeat(np.arange(PEOPLE), TIMES.size),
            times=np.tile(TIMES, PEOPLE),
            events={"time": [0.0], "dose": [DOSE]},
            observed=record,
        )
    return model


def sampled(model: pm.Model, number: int) -> tuple[dict[str, np.ndarray], float]:
    """Draws of sigma and CL, (chains, draws) each, and the least effective number."""
    for draws in LENGTHS:
        idata = psf.sample_dram(
            draws, tune=TUNE, chains=CHAINS, cores=1, model=model, random_seed=number,
            progressbar=False, check=False, compute_convergence_checks=False,
        )  # fmt: skip
        found = {name: idata["posterior"][name].values for name in NAMES}
        effective = min(float(az.ess(one)) for one in found.values())
        if effective >= N_KEPT:
            break
    return found, effective


def rank_of(true: float, draws: np.ndarray) -> int:
    """Among draws at equal distances, of one chain after the other."""
    flat = draws.ravel()
    kept = flat[np.arange(1, N_KEPT + 1) * flat.size // N_KEPT - 1]
    return int((kept < true).sum())


class Study:
    """Ranks, errors and CPU seconds of a filter."""

    def __init__(self) -> None:
        self.ranks: dict[str, list[int]] = {name: [] for name in NAMES}
        self.errors: dict[str, list[float]] = {name: [] for name in NAMES}
        self.seconds: list[float] = []

    def add(self, truth: dict[str, float], found: dict[str, np.ndarray], seconds: float) -> None:
        self.seconds.append(seconds)
        for name, draws in found.items():
            self.ranks[name].append(rank_of(truth[name], draws))
            self.errors[name].append(float((draws.mean() - truth[name]) / draws.std()))

    def lines(self, label: str) -> list[str]:
        """A row of the table for each parameter."""
        found = []
        for name in NAMES:
            ranks, errors = np.array(self.ranks[name]), np.array(self.errors[name])
            bins = " ".join(map(str, histogram(ranks, N_KEPT + 1, N_BINS)))
            error = f"{errors.mean():+.2f} ± {errors.std(ddof=1) / errors.size**0.5:.2f}"
            p = ecdf_p(ranks, N_KEPT + 1)
            cells = [label, name, bins, f"{p:.2g}", error, f"{np.mean(self.seconds):.1f}"]
            found.append(f"| {' | '.join(cells)} |")
        return found


def table_of(studies: dict[str, Study]) -> str:
    heads = ["study", "parameter", f"ranks in {N_BINS} bins", "p, ECDF"]
    heads += ["mean error, posterior sd", "CPU seconds a data set"]
    lines = [f"| {' | '.join(heads)} |", "| --- " * len(heads) + "|"]
    lines += [row for label, one in studies.items() for row in one.lines(label)]
    return "\n".join(lines) + "\n"


def main(n_data_sets: int, labels: list[str]) -> None:
    record = pytensor.shared(drawn(0, 0.15)[1], name="record")
    models = {label: model_of(*STUDIES[label], record) for label in labels}
    studies = {label: Study() for label in labels}
    for number in range(n_data_sets):
        for label, model in models.items():
            truth, observed = drawn(number, STUDIES[label][1])
            record.set_value(observed)
            began = time.process_time()
            found, effective = sampled(model, number)
            studies[label].add(truth, found, time.process_time() - began)
            last = [studies[label].ranks[name][-1] for name in NAMES]
            print(number, label, *last, f"{effective:.0f}", f"{studies[label].seconds[-1]:.1f}",
                  flush=True)  # fmt: skip
    print(table_of(studies))
    if labels == list(STUDIES):
        TABLE.write_text(table_of(studies))


if __name__ == "__main__":
    warnings.simplefilter("ignore", psf.errors.FilterWarning)
    count, *names = sys.argv[1:] or ["40"]
    main(int(count), names or list(STUDIES))
