"""dynestyx: NUTS of NumPyro on plates of the double well, by its continuous-discrete EKF.

Its moment equations are integrated by Euler's method with the step of our Euler-Maruyama scheme.
"""

import diffrax
import dynestyx as dsx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from dynestyx.inference.configs.filter import ContinuousTimeEKFConfig
from dynestyx.inference.filters import Filter
from dynestyx.models.core import ContinuousTimeStateEvolution, DynamicalModel
from dynestyx.models.diffusions import FullDiffusion
from dynestyx.models.observations import LinearGaussianObservation
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, NUTS

from benchmarks.peers.serve import RECORDS, serve

OBSERVED = jnp.asarray(RECORDS["panel"])
N_RECORDS, N_ROWS = OBSERVED.shape[:2]
TIMES = 0.2 * jnp.arange(N_ROWS)
EKF = ContinuousTimeEKFConfig(diffeqsolve_dt0=0.01, diffeqsolve_kwargs={"solver": diffrax.Euler()})


class Drift(eqx.Module):
    """Of one record, or of all on a leading axis."""

    alpha: jax.Array

    def __call__(self, x, u, t):
        return self.alpha * x - 4.0 * x**3


def model():
    mu = numpyro.sample("mu", dist.Normal(4.0, 2.0))
    tau = numpyro.sample("tau", dist.HalfNormal(1.0))
    with dsx.plate("records", N_RECORDS):
        alpha = numpyro.sample("alpha", dist.Normal(mu, tau))
        system = DynamicalModel(
            initial_condition=dist.MultivariateNormal(jnp.array([1.0]), 0.5 * jnp.eye(1)),
            state_evolution=ContinuousTimeStateEvolution(
                drift=Drift(alpha),
                # Of two Brownian motions with 0.6 and 0.1; it takes no more of them than states.
                diffusion=FullDiffusion(jnp.array([[0.37**0.5]]), bm_dim=1),
            ),
            observation_model=LinearGaussianObservation(H=jnp.eye(1), R=0.08 * jnp.eye(1)),
        )
        dsx.sample("d", system, obs_times=TIMES, obs_values=OBSERVED)


def log_likelihood(seed):
    at = {"alpha": jnp.full(N_RECORDS, 4.0), "mu": 4.0, "tau": 0.5}
    seeded = numpyro.handlers.seed(numpyro.handlers.substitute(model, at), seed)
    with Filter(filter_config=EKF):
        trace = numpyro.handlers.trace(seeded).get_trace()
    return float(jnp.sum(trace["d_marginal_loglik"]["value"]))


def chain(n_draws):
    def make():
        mcmc = MCMC(
            NUTS(model), num_warmup=n_draws, num_samples=n_draws, num_chains=1, progress_bar=False
        )

        def run(seed):
            with Filter(filter_config=EKF):
                mcmc.run(jax.random.key(seed))
            draws = np.asarray(mcmc.get_samples(group_by_chain=True)["alpha"])
            return float(np.median(effective_sample_size(draws)))

        return run

    return make


serve({"log_likelihood": lambda: log_likelihood, "nuts/400": chain(400)}, "dynestyx", "jax")
