"""pymcmcstat: its DRAM chains with the likelihood from the loop in ``loops.py``.

It does not use ``serve``: it runs one chain per seed and writes all of them to one file. ``python
-m benchmarks.peers.pymcmcstat_dram RECORDS CHAINS N_SEEDS TUNE DRAWS``
"""

import sys
import time
from functools import partial
from importlib.metadata import version

import numpy as np
import scipy

from benchmarks.loops import ekf_double_well

# Its release of 2021 imports a name that SciPy has since removed; with that restored, it runs.
scipy.pi, scipy.sin, scipy.cos = np.pi, np.sin, np.cos

from pymcmcstat.MCMC import MCMC  # noqa: E402

NAMES = ("alpha", "beta", "log_sigma", "log_gamma")


def minus_two_log_posterior(q, steps, observed):
    """Return the density that PyMC samples: scales in logs, with the Jacobian."""
    alpha, beta, log_sigma, log_gamma = q
    theta = np.array([alpha, beta, np.exp(log_sigma), np.exp(log_gamma)])
    prior = -0.5 * (alpha**2 + beta**2) / 100.0
    prior += -0.5 * (theta[2] ** 2 + theta[3] ** 2) + log_sigma + log_gamma
    return -2.0 * (ekf_double_well(theta, steps, observed) + prior)


def chain(seed, n, names, start, minus_two_log_density):
    """A chain of n draws from a start, and its CPU seconds."""
    np.random.seed(seed)  # noqa: NPY002 - it draws from the global generator
    mcmc = MCMC()
    mcmc.data.add_data_set(x=np.zeros(1), y=np.zeros(1))
    # Pass the record by closure: the data structure of the package is for regressions.
    mcmc.simulation_options.define_simulation_options(
        nsimu=n, updatesigma=False, method="dram", verbosity=0, waitbar=False
    )
    mcmc.model_settings.define_model_settings(
        sos_function=lambda q, data, custom=None: minus_two_log_density(q),
        sigma2=1.0,
    )
    for name, value in zip(names, start, strict=True):
        mcmc.parameters.add_model_parameter(
            name=name, theta0=value, prior_mu=0.0, prior_sigma=np.inf
        )
    begin = time.process_time()
    mcmc.run_simulation()
    return mcmc.simulation_results.results["chain"], time.process_time() - begin


def main(records, target, n_seeds, tune, draws):
    data = np.load(records)
    alpha, beta, sigma, gamma = data["double_well_theta"]
    start = np.array([alpha, beta, np.log(sigma), np.log(gamma)])
    steps, observed = data["steps"], data["double_well_observed"]
    density = partial(minus_two_log_posterior, steps=steps, observed=observed)
    density(start)
    chains, seconds = zip(
        *(chain(seed, tune + draws, NAMES, start, density) for seed in range(n_seeds)),
        strict=True,
    )
    np.savez(
        target, chains=np.array(chains)[:, tune:], seconds=seconds, version=version("pymcmcstat")
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
