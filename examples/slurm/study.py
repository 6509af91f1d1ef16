"""Three rival equations of a particle in a double well, on a laptop or on a cluster.

Run it in one process, in eight, or with SLURM:

    python study.py
    mpiexec -n 8 python -m mpi4py study.py
    sbatch job.sh

All of them draw the same numbers. A job that was killed resumes when it is started again, on any
number of ranks.
"""

import argparse
from pathlib import Path

import pymc as pm

import pymc_statespace_filters as psf

RIVALS = {"M1": ["alpha"], "M2": ["alpha", "beta"], "M3": ["alpha", "beta", "gamma"]}


def drift(x, alpha, beta=0.0, gamma=0.0):
    return [alpha * x[0] + beta * x[0] ** 3 + gamma * x[0] ** 5]


double_well = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, lambda sigma_m: [[0.6, sigma_m]], dt=0.01),
    observation=lambda x: [x[0]],
    observation_noise=[[0.08]],
    initial_mean=[1.0],
    initial_cov=[[0.5]],
)


def rival(parameters, filter, steps, observed):
    with pm.Model() as model:
        for name in parameters:
            pm.Normal(name, 0, 10)
        pm.HalfNormal("sigma_m", 1)
        psf.StateSpace("d", double_well, filter, steps=steps, observed=observed)
    return model


def study(out, quick):
    """Run on every rank; only the first rank gets the result."""
    filter, draws = (psf.EKF(), 2000) if quick else (psf.BootstrapPF(256), 8000)
    steps = range(0, 2001, 20)
    truth = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.0}
    record = psf.simulate(double_well, truth, steps=steps, random_seed=20)["observations"]
    models = {name: rival(names, filter, steps, record) for name, names in RIVALS.items()}
    results = psf.run_models(
        models,
        sampler="dram",
        draws=draws,
        tune=draws // 2,
        random_seed=1,
        checkpoint=out / "checkpoint",
        comm="world",
    )
    if results is None:
        return
    evidences = {
        name: psf.chib_jeliazkov(results[name], model, random_seed=1)
        for name, model in models.items()
    }
    table = psf.compare_evidence(evidences)
    table.to_csv(out / "model_probabilities.csv")
    print(table[["log_evidence", "se", "prob", "prob_low", "prob_high"]].round(3))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    parser.add_argument("--quick", action="store_true", help="a short form, for a first look")
    study(**vars(parser.parse_args()))
