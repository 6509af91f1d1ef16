"""`sample_smc` row by row against IBIS by hand, and other samplers, on a linear-Gaussian model.

An autoregression with three parameters, observed with noise. The IBIS is what one would write for
this model: Kalman's filter of numbers in numba, one population, resampling at half the effective
size and five steps of a random walk. The figure is the squared error of the log-evidence, from its
spread over seeds, times CPU seconds, after compilation, on one core. Run it with
``python -m benchmarks.ibis 20`` from the root of the repository, for 20 seeds; with
``particles 5`` in an environment with that library and no other for its SMC^2.

With 3 seeds, on a core shared with other work: by hand sd .120 in .94 CPU s, tempered .019 in
2.01, sequential .164 in 2.52; `pm.sample_smc`, with a tenth of the particles, .028 in .88 (2
seeds). Sequential with `BootstrapPF(100)` and 100 draws: 10 CPU s; particles, with 1000, had not
ended after 200 s of wall clock on a share of a core.
"""

import math
import os
import sys
import time

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import numpy as np
from numba import njit

N_ROWS = 200
DRAWS = 1000  # of each of 10 populations; 10 000 particles by hand
TRUTH = 0.8, 0.0, 0.0  # coefficient, logs of the deviations of noise and sensor


def record() -> np.ndarray:
    """A simulated record."""
    rng, x, found = np.random.default_rng(1), 0.0, []
    for _ in range(N_ROWS):
        x = TRUTH[0] * x + rng.standard_normal()
        found.append(x + rng.standard_normal())
    return np.array(found)


def prior_draws(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws (count, 3) of the prior, all standard normal."""
    return rng.standard_normal((count, 3))


@njit(cache=True)
def update(theta, mean, variance, y):
    """One step of Kalman's filter and its term."""
    a, q, r = theta[0], math.exp(2 * theta[1]), math.exp(2 * theta[2])
    mean, variance = a * mean, a * a * variance + q
    spread = variance + r
    term = -0.5 * (math.log(2 * math.pi * spread) + (y - mean) ** 2 / spread)
    gain = variance / spread
    return mean + gain * (y - mean), (1 - gain) * variance, term


@njit(cache=True)
def add_row(theta, means, variances, y, terms):
    for i in range(len(theta)):
        means[i], variances[i], terms[i] = update(theta[i], means[i], variances[i], y)


@njit(cache=True)
def filter_all(theta, observed, means, variances, logs):
    for i in range(len(theta)):
        mean, variance, total = 0.0, 1.0, 0.0
        for y in observed:
            mean, variance, term = update(theta[i], mean, variance, y)
            total += term
        means[i], variances[i], logs[i] = mean, variance, total


def ibis(observed: np.ndarray, count: int, seed: int, n_moves: int = 5) -> float:
    """The log-evidence (Chopin 2002)."""
    rng = np.random.default_rng(seed)
    theta = prior_draws(count, rng)
    means, variances, logs = np.zeros(count), np.ones(count), np.zeros(count)
    terms, log_w, evidence = np.empty(count), np.full(count, -math.log(count)), 0.0
    for j, y in enumerate(observed):
        add_row(theta, means, variances, y, terms)
        logs += terms
        log_w += terms
        peak = log_w.max()
        w = np.exp(log_w - peak)
        evidence += peak + math.log(w.sum())
        w /= w.sum()
        log_w = np.log(w)
        if 1 / (w**2).sum() > 0.5 * count:
            continue
        places = (rng.random() + np.arange(count)) / count
        index = np.minimum(np.searchsorted(np.cumsum(w), places), count - 1)
        chol = np.linalg.cholesky(np.cov(theta.T, aweights=w)) * 2.38 / math.sqrt(3)
        theta, means, variances, logs = theta[index], means[index], variances[index], logs[index]
        log_w = np.full(count, -math.log(count))
        for _ in range(n_moves):
            new = theta + rng.standard_normal((count, 3)) @ chol.T
            own = [np.empty(count) for _ in range(3)]
            filter_all(new, observed[: j + 1], *own)
            gain = own[2] - logs + 0.5 * ((theta**2).sum(axis=1) - (new**2).sum(axis=1))
            accepted = np.log(rng.random(count)) < gain
            for old, proposed in zip((theta, means, variances, logs), (new, *own), strict=True):
                old[accepted] = proposed[accepted]
    return evidence


def linear_model(filter):
    """The same as a PyMC model."""
    import pymc as pm

    import pymc_statespace_filters as psf

    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=lambda log_q: [[pm.math.exp(2 * log_q)]],
        observation=lambda x: [x[0]],
        observation_noise=lambda log_r: [[pm.math.exp(2 * log_r)]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
    )
    with pm.Model() as model:
        for name in system.parameters:
            pm.Normal(name)
        psf.StateSpace("y", system, filter, steps=np.arange(1, N_ROWS + 1), observed=record())
    return model


def ours(seed: int, filter_name: str, data: str, draws: int = DRAWS) -> float:
    """By `sample_smc`."""
    import pymc_statespace_filters as psf

    filter = psf.EKF() if filter_name == "EKF" else psf.BootstrapPF(100)
    return psf.sample_smc(
        draws, model=linear_model(filter), data=data, random_seed=seed, progressbar=False,
        compute_convergence_checks=False,
    ).attrs["log_evidence"]  # fmt: skip


def pymc_smc(seed: int) -> float:
    """By `pm.sample_smc`, in four chains of 250 draws, with the likelihood of the package."""
    import pymc as pm

    import pymc_statespace_filters as psf

    with linear_model(psf.EKF()):
        found = pm.sample_smc(
            250, chains=4, cores=1, random_seed=seed, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    chains = found["sample_stats"]["log_marginal_likelihood"].values
    last = np.array([chain[~np.isnan(chain)][-1] for chain in np.asarray(chains, float)])
    return float(np.log(np.mean(np.exp(last - last.max()))) + last.max())


def particles_smc2(seed: int) -> float:
    """By the library particles: 1000 parameters, 100 states, waste-free."""
    from particles import SMC, distributions, state_space_models
    from particles.smc_samplers import SMC2

    class Autoregression(state_space_models.StateSpaceModel):
        def PX0(self):
            return distributions.Normal(0.0, math.sqrt(self.a**2 + math.exp(2 * self.log_q)))

        def PX(self, t, xp):
            return distributions.Normal(self.a * xp, math.exp(self.log_q))

        def PY(self, t, xp, x):
            return distributions.Normal(x, math.exp(self.log_r))

    names = ("a", "log_q", "log_r")
    prior = distributions.StructDist({name: distributions.Normal() for name in names})
    np.random.seed(seed)  # noqa: NPY002 (that library draws from it)
    model = SMC2(
        ssm_cls=Autoregression, prior=prior, data=record(), init_Nx=100, wastefree=True,
        len_chain=20, ar_to_increase_Nx=0.1,
    )  # fmt: skip
    run = SMC(fk=model, N=50)
    run.run()
    return float(run.summaries.logLts[-1])


RIVALS = {
    "by hand": lambda seed: ibis(record(), 10 * DRAWS, seed),
    "sequential, EKF": lambda seed: ours(seed, "EKF", "sequential"),
    "tempered, EKF": lambda seed: ours(seed, "EKF", "tempered"),
    "pm.sample_smc": pymc_smc,
    "sequential, BootstrapPF(100)": lambda seed: ours(seed, "BootstrapPF", "sequential"),
}


def compare(names, n_seeds: int) -> None:
    """Print the spread of the log-evidence and CPU seconds of each."""
    for name in names:
        run = particles_smc2 if name == "particles" else RIVALS[name]
        run(0)  # compilation
        began = time.process_time()
        found = np.array([run(seed) for seed in range(1, n_seeds + 1)])
        seconds = (time.process_time() - began) / n_seeds
        variance = found.var(ddof=1)
        print(
            f"{name}: {found.mean():.3f}, sd {variance**0.5:.3f}, {seconds:.2f} CPU s, "
            f"variance x seconds {variance * seconds:.4f}",
            flush=True,
        )


if __name__ == "__main__":
    *names, n_seeds = sys.argv[1:]
    compare(names or RIVALS, int(n_seeds))
