"""Coverage of the intervals of the log-evidence by `sample_smc(data="sequential")`.

A particle filter of few members is inside, whose number is doubled on the way, and the evidence is
known by quadrature. Each run has many populations beside one pilot; they are divided at random into
tens, several times. Run it with ``python -m benchmarks.evidence_coverage 60 12 1700`` from the root
of the repository, for 60 draws in each population and 12 runs, with seeds from 1700. The figures
of the guide are of this call, and of ``200 5 900``.
"""

import sys
import warnings

import numpy as np

import pymc_statespace_filters as psf
from pymc_statespace_filters.smc.merging import merged_log_evidence
from tests.parameter_particles.autoregression import exact, model

POPULATIONS, N_DIVISIONS = 200, 50


def main(draws: int, n_runs: int, first_seed: int) -> None:
    warnings.simplefilter("ignore", psf.errors.EvidenceWarning)
    rng, particles = np.random.default_rng(1), model(psf.BootstrapPF(15))
    runs = [
        psf.sample_smc(
            draws, model=particles, data="sequential", populations=POPULATIONS, random_seed=seed,
            progressbar=False, compute_convergence_checks=False,
        )
        for seed in range(first_seed, first_seed + n_runs)
    ]  # fmt: skip
    found = np.stack([run["smc"]["log_evidence"].values for run in runs]) - exact().path[-1]
    divided = np.concatenate(
        [rng.permuted(found, axis=1).reshape(-1, 10) for _ in range(N_DIVISIONS)]
    )
    value, error = merged_log_evidence(divided.T)
    z, ratios = value / error, np.exp(found)
    mean_error = ratios.std(ddof=1) / ratios.size**0.5
    print(
        f"{draws} draws: populations scatter by {ratios.std():.2f} of the evidence, their mean is "
        f"{ratios.mean():.3f} +- {mean_error:.3f} of it"
    )
    within, below, above = (abs(z) < 1.96).mean(), (z < -1.96).mean(), (z > 1.96).mean()
    print(f"of 95 % intervals {within:.3f} hold, {below:.3f} are below, {above:.3f} above")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
