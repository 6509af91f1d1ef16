"""A short run of the installed package, from an equation to an evidence, on an empty cache."""

from time import perf_counter

start = perf_counter()

import numpy as np  # noqa: E402
import pymc as pm  # noqa: E402

import pymc_statespace_filters as psf  # noqa: E402


def main() -> None:
    """Simulate a record, and estimate what it was made with."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=[[0.5]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
    )
    steps = np.arange(1, 41)
    path = psf.simulate(system, {"a": 0.8}, steps=steps, random_seed=1)
    observed = path["observations"].values
    record = {"observed": observed, "steps": steps}
    exact = psf.log_likelihood(system, psf.EKF(), {"a": 0.8}, **record).sum()
    print(f"first log-likelihood after {perf_counter() - start:.1f} s")
    estimates = psf.log_likelihood(
        system, psf.BootstrapPF(500), {"a": 0.8}, **record, seed=np.arange(20)
    ).sum(axis=-1)
    assert abs(np.log(np.mean(np.exp(estimates - exact)))) < 0.5, (exact, estimates)
    with pm.Model():
        pm.Uniform("a", -1, 1)
        psf.StateSpace("d", system, psf.EKF(), **record)
        idata = psf.sample_dram(1000, tune=500, random_seed=1)
        evidence = psf.chib_jeliazkov(idata, random_seed=1)
    # The likelihood is that of a linear system, so a sum over a fine grid gives the evidence.
    a = np.linspace(-1, 1, 2001)
    terms = psf.log_likelihood(system, psf.EKF(), {"a": a}, **record).sum(axis=-1)
    known = np.log(np.mean(np.exp(terms - terms.max()))) + terms.max()
    assert abs(evidence.log_evidence - known) < 5 * evidence.se + 1e-3, (evidence, known)
    print(f"log-evidence {evidence.log_evidence:.3f} +- {evidence.se:.3f}, exactly {known:.3f}")
    print(f"version {psf.__version__}, {perf_counter() - start:.1f} s in all")


if __name__ == "__main__":
    main()
