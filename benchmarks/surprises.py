"""How far each filter falls below the exact log-likelihood on a record with surprises.

The record is a double well observed by a precise sensor: a thousand observations, of which three
are 5, 6 and 7 predicted standard deviations off. The reference is a point-mass filter. All numbers
are in nats, filter minus reference: over the whole record, at each surprise with the observation
after it, and elsewhere. Run it with ``python -m benchmarks.surprises`` from the root of the
repository; it takes five minutes.
"""

import time
import warnings

import numpy as np

import pymc_statespace_filters as psf
from tests.references.records import PRECISE_DOUBLE_WELL, SURPRISES, double_well_with_surprises
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters

FILTERS = (
    (psf.EKF(), 1),
    *((psf.EnKF(n, likelihood="gaussian"), 20) for n in (250, 1250, 5000)),
    *((psf.EnKF(n), 20) for n in (250, 1250, 5000)),
    *((psf.BootstrapPF(n), 20) for n in (250, 1250, 5000, 20_000, 80_000)),
    *(
        (psf.PFEnKF(n, likelihood=likelihood), n_seeds)
        for likelihood in ("predictive", "weights")
        for n, n_seeds in ((250, 10), (1000, 4))
    ),
)


def errors(filter, n_seeds, truth) -> tuple[np.ndarray, bool]:
    """Return errors of the terms (n_seeds, J), and whether the package warned."""
    record = double_well_with_surprises()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        terms = psf.log_likelihood(
            DOUBLE_WELL_SYSTEM,
            filter,
            double_well_parameters(PRECISE_DOUBLE_WELL),
            record.observed,
            steps=record.steps,
            seed=np.arange(n_seeds),
        )
    return terms - truth, any(w.category is psf.errors.FilterWarning for w in caught)


def main() -> None:
    truth = PRECISE_DOUBLE_WELL.point_mass_filter().run(*double_well_with_surprises()).terms
    print(f"truth: {truth.sum():.2f}, at the surprises {truth[list(SURPRISES)].round(1)}")
    print("filter | seeds | whole record: mean, sd, lowest | at surprises | elsewhere | warned | s")
    for filter, n_seeds in FILTERS:
        start = time.process_time()
        error, warned = errors(filter, n_seeds, truth)
        seconds = (time.process_time() - start) / n_seeds
        total = error.sum(axis=1)
        at = np.array([(error[:, j] + error[:, j + 1]).mean() for j in SURPRISES])
        print(
            f"{filter} | {n_seeds} | {total.mean():.1f}, {total.std():.1f}, {total.min():.1f} | "
            f"{at.round(1)} | {total.mean() - at.sum():.1f} | {warned} | {seconds:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
