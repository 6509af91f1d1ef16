"""Evidence of noisy likelihoods by few particles and importance sampling, by evaluations.

The rivals M2 and M3 of the double well (`examples/double_well.py`), with `BootstrapPF(200)`:
`sample_smc` with few draws says where the posterior lies, and `estimate_evidence` integrates there.
Run it with ``python -m benchmarks.smc_evidence 100 5`` from the root of the repository, for 100
draws in each of 10 populations and 5 seeds.

The largest likelihood takes some 400 evaluations more in each call, which are in these figures, not
in the output. The checks at the end of `sample_smc` are left out. M2 took 9 300 to 12 300
evaluations, with standard errors from 0.032 to 0.047; the five estimates have the mean -50.55 and
the standard deviation 0.04, those by SMC alone -50.88 and 0.31. M3 took 12 300 to 24 300, with
errors from 0.037 to 0.047 and one of 0.079, above the target of 0.05; mean -50.84, standard
deviation 0.06, by SMC alone -50.79 and 0.54. The largest error of a mean of a parameter is 0.05 to
0.2 (M2) and 0.05 to 0.5 (M3) of its standard deviation. With 200 draws and 3 seeds both took 17 200
to 19 200 evaluations, with errors from 0.033 to 0.048.

Chains (`sample_dram(1500, tune=500)`, chib_jeliazkov and bridge) took 10 700, with errors of 0.03
to 0.04.
"""

import sys
import warnings

import numpy as np

import pymc_statespace_filters as psf
from examples.double_well import DT, RECORD_SEED, RIVALS, TRUTH, double_well, rival

N_MEMBERS = 200


def record() -> tuple[np.ndarray, np.ndarray]:
    """That of the example."""
    steps = np.arange(0, int(20 / DT) + 1, 20)
    found = psf.simulate(double_well, TRUTH, steps=steps, random_seed=RECORD_SEED)
    return steps, found["observations"].values[:, 0]


def main(draws: int, n_seeds: int) -> None:
    warnings.simplefilter("ignore", psf.errors.EvidenceWarning)
    for name in ("M2", "M3"):
        model = rival(RIVALS[name], psf.BootstrapPF(N_MEMBERS), *record())
        for seed in range(1, n_seeds + 1):
            settings = {"model": model, "random_seed": seed, "progressbar": False}
            idata = psf.sample_smc(draws, compute_convergence_checks=False, **settings)
            found = psf.estimate_evidence(idata, **settings)["importance"]
            stored = idata["evidence"].to_dataset().sel(estimator="importance")
            n = 11 * draws + int(idata["smc"]["n_evaluated"].sum() + stored["n_proposals"])
            relative = idata["mcse"].to_dataset() / idata["posterior"].std(("chain", "draw"))
            worst = max(float(values) for values in relative.data_vars.values())
            print(
                f"{name}, seed {seed}: {found.log_evidence:.3f} +- {found.se:.3f} (SMC alone "
                f"{idata.attrs['log_evidence']:.2f} +- {idata.attrs['log_evidence_se']:.2f}), "
                f"{n} evaluations; errors of means at most {worst:.2f} of the posterior's sd",
                flush=True,
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
