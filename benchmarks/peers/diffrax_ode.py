"""diffrax: the equation of lynx and hare by adaptive steps, and NUTS of numpyro on it.

Tsit5 with the tolerance 1e-6, which takes some 60 steps, and the package's default adjoint. Chains
do not use ``serve``: ``python -m benchmarks.peers.diffrax_ode RECORDS CHAINS N_SEEDS TUNE DRAWS``
writes all of them to one file.
"""

import sys
import time
from importlib.metadata import version

import numpy as np

from benchmarks.peers.serve import RECORDS, serve

import jax  # isort: skip  # after serve, which sets its options
import diffrax
import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist
from numpyro.infer import MCMC, NUTS, init_to_value

from benchmarks.peers import jax_systems

AT, LOGS = RECORDS["lynx_hare_theta"], jnp.asarray(RECORDS["lynx_hare_observed"])
TIMES = jnp.asarray(RECORDS["lynx_hare_times"])
NAMES = ("alpha", "beta", "gamma", "delta", "hare", "lynx", "s_hare", "s_lynx")
numpyro.enable_x64()


def rates(t, x, p):
    alpha, beta, gamma, delta = p
    hare, lynx = x
    return jnp.stack([(alpha - beta * lynx) * hare, (delta * hare - gamma) * lynx])


def path(theta):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        diffrax.Tsit5(),
        t0=0.0,
        t1=20.0,
        dt0=0.02,
        y0=jnp.stack([theta[4], theta[5]]),
        args=tuple(theta[:4]),
        saveat=diffrax.SaveAt(ts=TIMES),
        stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        max_steps=1024,
        throw=False,
    )
    return solution.ys


def log_likelihood(theta):
    z = (LOGS - jnp.log(path(theta))) / theta[6:]
    return -0.5 * jnp.sum(z**2) - LOGS.shape[0] * jnp.sum(jnp.log(theta[6:] * jnp.sqrt(2 * jnp.pi)))


def model():
    def positive(name, mean, sd):
        return numpyro.sample(name, dist.TruncatedNormal(mean, sd, low=0.0))

    p = [positive(name, *((1.0, 0.5), (0.05, 0.05))[i % 2]) for i, name in enumerate(NAMES[:4])]
    p += [numpyro.sample(name, dist.LogNormal(jnp.log(10.0), 1.0)) for name in NAMES[4:6]]
    p += [numpyro.sample(name, dist.LogNormal(-1.0, 1.0)) for name in NAMES[6:]]
    theta = jnp.stack(p)
    logs = jnp.log(jnp.maximum(path(theta), 1e-300))
    numpyro.sample("d", dist.Normal(logs, theta[6:]), obs=LOGS)


def chains(target, n_seeds, tune, draws):
    """Write a chain per seed, and CPU seconds of whole runs: compiled by a run before."""
    start = init_to_value(values=dict(zip(NAMES, AT, strict=True)))
    mcmc = MCMC(
        NUTS(model, init_strategy=start), num_warmup=tune, num_samples=draws, progress_bar=False
    )
    mcmc.run(jax.random.PRNGKey(1000))
    found, seconds = [], []
    for seed in range(n_seeds):
        begin = time.process_time()
        mcmc.run(jax.random.PRNGKey(seed))
        samples = mcmc.get_samples()
        found.append(np.stack([np.asarray(samples[name]) for name in NAMES], axis=1))
        seconds.append(time.process_time() - begin)
    np.savez(target, chains=np.array(found), seconds=seconds, version=version("diffrax"))


def task(gradient):
    return lambda: jax_systems.call_of(log_likelihood, jnp.asarray(AT), gradient)


if len(sys.argv) > 2:
    chains(sys.argv[2], *map(int, sys.argv[3:]))
else:
    serve({"value": task(False), "gradient": task(True)}, "diffrax", "numpyro", "jax")
