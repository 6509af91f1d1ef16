"""Noise and time of filters of a switching oscillator, with a coarse and with a precise sensor.

The damping of a linear oscillator switches, some eight times along a record of 400 steps with an
observation after every fourth. Numbers are of the log-likelihood at the true parameters, in nats:
its mean over seeds minus the exact one, its standard deviation, CPU milliseconds of an evaluation,
and variance times time relative to ``BootstrapPF(1000)``. Exact is the log of the mean likelihood
of ``RBPF(20_000)``, which is unbiased. Run it with ``python -m benchmarks.regimes`` from the root
of the repository; it takes a minute.

``python -m benchmarks.regimes ENVIRONMENT`` compares NUTS with that of NumPyro instead, for a
hidden Markov model of a thousand observations. ENVIRONMENT is a folder in which dynamax and numpyro
are installed: ``python -m venv ENVIRONMENT; ENVIRONMENT/bin/pip install dynamax numpyro``.
"""

import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import pymc_statespace_filters as psf

DT, STEPS, N_SEEDS = 0.1, np.arange(0, 400, 4), 200
TRUTH = {"omega": 2.0, "low": 0.1, "high": 3.0, "stay": 0.98}
FILTERS = psf.IMM(), psf.RBPF(10), psf.RBPF(100), psf.BootstrapPF(1000)


def _noise(x, stay):
    regime = pm.Bernoulli.dist(pt.switch(x[2] > 0.5, stay, 1 - stay))
    return [regime, pm.Normal.dist(0, 0.3 * np.sqrt(DT))]


def _step(x, q, omega, low, high):
    damping = pt.switch(q[0] > 0.5, high, low)
    velocity = x[1] + DT * (-(omega**2) * x[0] - damping * x[1]) + q[1]
    return [x[0] + DT * velocity, velocity, q[0]]


def oscillator(sensor):
    """A linear oscillator whose damping switches, and the standard deviation of its sensor."""
    return psf.StateSpaceModel(
        transition=_step,
        process_dist=_noise,
        observation=lambda x: [x[0]],
        observation_noise=[[sensor**2]],
        initial_dist=lambda: [
            pm.Normal.dist(1, 0.1), pm.Normal.dist(0, 0.1), pm.Bernoulli.dist(0.5)
        ],
        dt=DT,
        states=["position", "velocity", "regime"],
    )  # fmt: skip


def _log_likelihoods(system, filter, observed, seeds):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", psf.errors.FilterWarning)
        terms = psf.log_likelihood(system, filter, TRUTH, observed, steps=STEPS, seed=seeds)
    return np.atleast_2d(terms).sum(axis=-1)


def main():
    """Print a table for each sensor."""
    for sensor in (0.2, 0.005):
        system = oscillator(sensor)
        record = psf.simulate(system, TRUTH, steps=STEPS, random_seed=2)
        observed = record["observations"].values
        many = _log_likelihoods(system, psf.RBPF(20_000), observed, np.arange(10))
        exact, rows = logsumexp(many) - np.log(many.size), []
        for filter in FILTERS:
            _log_likelihoods(system, filter, observed, 0)  # compiled
            began = time.process_time()
            found = _log_likelihoods(system, filter, observed, np.arange(N_SEEDS))
            seconds = (time.process_time() - began) / N_SEEDS
            rows.append((str(filter), found.mean() - exact, found.std(), 1e3 * seconds))
        plain = rows[-1][2] ** 2 * rows[-1][3]
        print(f"sensor of standard deviation {sensor}; exact to {many.std() / 10**0.5:.3f}")
        for filter, bias, sd, ms in rows:
            ratio = f"{ms:.2f} ms, 1/{plain / (sd**2 * ms):.0f}" if sd > 1e-9 else "without noise"
            print(f"{filter} | {bias:+.3f} +- {sd:.3f} | {ratio}")


HMM = psf.StateSpaceModel(
    transition=lambda x, q: [q[0]],
    process_dist=lambda x, up, down: [pm.Bernoulli.dist(pt.switch(x[0] > 0.5, 1 - down, up))],
    observation=lambda x, level: [level * x[0]],
    observation_noise=lambda s: [[s**2]],
    initial_dist=lambda up, down: [pm.Bernoulli.dist(up / (up + down))],
    states=["regime"],
)
N_CHAINS, N_DRAWS = 2, 300


def hidden_markov_model(observed):
    """Two regimes, of which one has the mean zero."""
    with pm.Model() as model:
        pm.Beta("up", 1, 9)
        pm.Beta("down", 1, 9)
        pm.Normal("level", 0, 2)
        pm.HalfNormal("s", 1)
        psf.StateSpace(
            "d", HMM, psf.FiniteStateFilter(), steps=np.arange(len(observed)), observed=observed
        )
    return model


def _report(name, posterior, seconds):
    effective = min(float(x) for x in az.ess(posterior).data_vars.values())
    mean = {key: round(float(x), 3) for key, x in posterior.mean().data_vars.items()}
    print(f"{name} | {effective:.0f} in {seconds:.1f} s: {effective / seconds:.0f} / s | {mean}")


def compare_with_dynamax(environment):
    """Print effective draws per CPU second of runs whose code is compiled, tuning included."""
    truth = {"up": 0.1, "down": 0.2, "level": 1.0, "s": 0.5}
    record = psf.simulate(HMM, truth, steps=np.arange(1000), random_seed=1)
    observed = record["observations"].values
    settings = {"chains": N_CHAINS, "cores": 1, "progressbar": False, "sampler": "nuts"}
    with hidden_markov_model(observed):
        psf.sample(20, tune=20, random_seed=1, **settings)
        began = time.process_time()
        idata = psf.sample(N_DRAWS, tune=N_DRAWS, random_seed=2, **settings)
        seconds = time.process_time() - began
    _report("psf.sample", idata["posterior"].to_dataset(), seconds)
    with tempfile.TemporaryDirectory() as folder:
        data, draws = Path(folder, "data.npy"), Path(folder, "draws.npz")
        np.save(data, observed[:, 0])
        python = Path(environment, "bin", "python")
        words = [python, "-m", "benchmarks.peers.dynamax_hmm", data, draws, N_CHAINS, N_DRAWS]
        subprocess.run(list(map(str, words)), check=True)
        found = dict(np.load(draws))
    seconds = float(found.pop("seconds"))
    posterior = az.from_dict({"posterior": found})["posterior"].to_dataset()
    _report("dynamax, NumPyro", posterior, seconds)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        compare_with_dynamax(sys.argv[1])
    else:
        main()
