"""pypomp: its bootstrap filter on the epidemic of `benchmarks.epidemic`.

Its own samplers from quantile functions, all particles at once (``@vectorized``), in single
precision: its fastest form on a processor without a GPU.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pypomp
from pypomp.functional import pfilter
from pypomp.models.measles import _samplers

from benchmarks.peers.serve import RECORDS, serve

jax.config.update("jax_enable_x64", False)

NAMES = ("R0", "amplitude", "sigma_se", "rho", "k")
POPULATION, TURNOVER, LATENCY, INFECTIOUS, IMPORTED = 1e6, 0.02 / 365.0, 8.0, 5.0, 2.0
START = {"S": 5.5e4, "E": 160.0, "I": 100.0, "C": 0.0}


def rinit(theta_, key, covars=None, t0=None):
    return START


@pypomp.vectorized
def rproc(X_, theta_, key, covars, t, dt):
    S, E, I, C = (X_[name] for name in "SEIC")  # noqa: E741
    uniforms = jax.random.uniform(key, (_samplers.N_GAMMA_UNIFORMS + 7, S.shape[0]))
    of_gamma, u = jnp.split(uniforms, [_samplers.N_GAMMA_UNIFORMS])
    variance = theta_["sigma_se"] ** 2 / dt
    noise = _samplers.gamma(of_gamma, 1.0 / variance) * variance
    season = 1.0 + theta_["amplitude"] * jnp.cos(2.0 * jnp.pi * t / 365.0)
    rate = theta_["R0"] / INFECTIOUS * season * (I + IMPORTED) / POPULATION * noise
    births = _samplers.poisson(u[0], TURNOVER * POPULATION * dt)
    infected, s_died = _samplers.euler_exits(u[1], u[2], S, rate, TURNOVER, dt)
    emerged, e_died = _samplers.euler_exits(u[3], u[4], E, 1.0 / LATENCY, TURNOVER, dt)
    recovered, i_died = _samplers.euler_exits(u[5], u[6], I, 1.0 / INFECTIOUS, TURNOVER, dt)
    return {
        "S": S + births - infected - s_died,
        "E": E + infected - emerged - e_died,
        "I": I + emerged - recovered - i_died,
        "C": C + recovered,
    }


def dmeas(Y_, X_, theta_, covars=None, t=None):
    y, k = Y_["cases"], theta_["k"]
    mean = theta_["rho"] * X_["C"] + 1e-3
    log = jax.scipy.special.gammaln(y + k) - jax.scipy.special.gammaln(k)
    log -= jax.scipy.special.gammaln(y + 1.0)
    return log + k * jnp.log(k / (k + mean)) + y * jnp.log(mean / (k + mean))


def seir(n_particles):
    steps, cases = RECORDS["epidemic_steps"], RECORDS["epidemic_observed"][:, 0]
    theta = dict(zip(NAMES, map(float, RECORDS["epidemic_theta"]), strict=True))
    model = pypomp.Pomp(
        ys=pd.DataFrame({"cases": cases}, index=steps.astype(float)),
        theta=pypomp.PompParameters(theta),
        statenames=list(START),
        t0=0.0,
        dt=1.0,
        accumvars=["C"],
        rinit=rinit,
        rproc=rproc,
        dmeas=dmeas,
    )
    struct = model.to_struct()
    values = jnp.array([[theta[name] for name in struct.param_names]])
    keys = jax.jit(lambda seed: jax.random.split(jax.random.key(seed), (1, 1)))

    def value(seed):
        found = pfilter(struct, values, n_particles, keys(seed))
        return float(np.asarray(found["logLik"]).ravel()[0])

    return lambda: value


serve({f"epidemic/bootstrap/{n}": seir(n) for n in (1000,)}, "pypomp", "jax")
