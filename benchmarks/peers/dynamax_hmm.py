"""dynamax's hidden Markov model with NumPyro's NUTS: draws, and the CPU seconds of a second run.

Called by ``benchmarks.regimes`` with a file of observations and one for the draws.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from dynamax.hidden_markov_model import hmm_filter
from numpyro.infer import MCMC, NUTS

jax.config.update("jax_enable_x64", True)


def model(observed):
    """As `benchmarks.regimes.hidden_markov_model`."""
    up, down = (numpyro.sample(name, dist.Beta(1, 9)) for name in ("up", "down"))
    level = numpyro.sample("level", dist.Normal(0, 2))
    s = numpyro.sample("s", dist.HalfNormal(1))
    start = jnp.stack([down, up]) / (up + down)
    P = jnp.array([[1 - up, up], [down, 1 - down]])
    log_p = dist.Normal(level * jnp.arange(2), s).log_prob(observed[:, None])
    numpyro.factor("data", hmm_filter(start, P, log_p).marginal_loglik)


def main(observations, draws_to, chains, draws):
    """Write the draws, and the seconds of a run whose code is compiled."""
    observed = jnp.asarray(np.load(observations))
    mcmc = MCMC(
        NUTS(model), num_warmup=draws, num_samples=draws, num_chains=chains,
        chain_method="sequential", progress_bar=False,
    )  # fmt: skip
    mcmc.run(jax.random.key(0), observed)
    began = time.process_time()
    mcmc.run(jax.random.key(1), observed)
    found = {name: np.asarray(x) for name, x in mcmc.get_samples(group_by_chain=True).items()}
    np.savez(draws_to, seconds=time.process_time() - began, **found)


if __name__ == "__main__":
    main(*sys.argv[1:3], *map(int, sys.argv[3:5]))
