"""cuthbert: its extended Kalman, ensemble Kalman and bootstrap filters, jitted.

It predicts before each update, so the first cycle has steps of length zero. The ensembles take all
20 steps between two observations inside one prediction. The extended Kalman filter linearises one
step at a time, with NaN at the steps without an observation, which it skips.
"""

from functools import partial

import numpy as np

from benchmarks.peers.serve import every_step, record, serve

import jax  # isort: skip  # after serve, which sets its options
import jax.numpy as jnp
from cuthbert import filter as run_filter
from cuthbert.ensemble_kalman import ensemble_kalman_filter
from cuthbert.gaussian.moments import build_filter as build_moments
from cuthbert.smc import particle_filter
from cuthbertlib.resampling import adaptive, systematic

DT = 0.01
THETA, STEPS, _, OBSERVED = record("double_well")
GAPS = int(np.diff(STEPS)[0])
# Lengths of the steps of each cycle: the first cycle is only an update.
STEP = jnp.full(len(STEPS), DT).at[0].set(0.0)


def initial(key):
    return 1.0 + jnp.sqrt(0.5) * jax.random.normal(key, (1,))


def twenty_steps(theta, dt, x, key):
    alpha, beta, sigma, _ = theta
    scale = jnp.sqrt(dt * (0.36 + sigma**2))
    z = jax.random.normal(key, (GAPS,))

    def step(k, x):
        return x + dt * (alpha * x + beta * x * x * x) + scale * z[k]

    return jax.lax.fori_loop(0, GAPS, step, x)


def last(states):
    return states.log_normalizing_constant[-1]


def ekf(theta):
    alpha, beta, sigma, gamma = theta
    rows = jnp.asarray(every_step(STEPS, OBSERVED))
    step = jnp.full(len(rows), DT).at[0].set(0.0)

    def dynamics(state, inputs):
        dt, _ = inputs

        def moments(x):
            chol = jnp.sqrt(dt * (0.36 + sigma**2)) * jnp.eye(1)
            return x + dt * (alpha * x + beta * x * x * x), chol

        return moments, state.mean

    def observation(state, inputs):
        return lambda x: (x, jnp.sqrt(gamma) * jnp.eye(1)), state.mean, inputs[1]

    chol = jnp.sqrt(0.5) * jnp.eye(1)
    model = build_moments(jnp.array([1.0]), chol, dynamics, observation)
    return last(run_filter(model, (step, rows), model.init_prepare()))


def enkf(n_members, theta, key):
    def dynamics(inputs):
        return lambda x, key: twenty_steps(theta, inputs[0], x, key)

    def observations(inputs):
        return lambda x: x, jnp.sqrt(theta[3]) * jnp.eye(1), inputs[1]

    model = ensemble_kalman_filter.build_filter(initial, dynamics, observations, n_members)
    start, run = jax.random.split(key)
    states = run_filter(
        model, (STEP, jnp.asarray(OBSERVED)), model.init_prepare(key=start), key=run
    )
    return last(states)


def bootstrap(n_particles, theta, key):
    def log_potential(previous, x, inputs):
        r = inputs[1][0] - x[0]
        return -0.5 * (jnp.log(2.0 * jnp.pi * theta[3]) + r * r / theta[3])

    model = particle_filter.build_filter(
        initial,
        lambda key, x, inputs: twenty_steps(theta, inputs[0], x, key),
        log_potential,
        n_particles,
        adaptive.ess_decorator(systematic.resampling, 1 / 3),
    )
    start, run = jax.random.split(key)
    states = run_filter(
        model, (STEP, jnp.asarray(OBSERVED)), model.init_prepare(key=start), key=run
    )
    return last(states)


def deterministic(value):
    def make():
        run = jax.jit(value)
        return lambda seed: jax.block_until_ready(run(THETA))

    return make


def gradient():
    run = jax.jit(jax.value_and_grad(ekf))
    return lambda seed: jax.block_until_ready(run(THETA))[0]


def estimate(filter, n):
    def make():
        run = jax.jit(partial(filter, n))
        return lambda seed: run(THETA, jax.random.key(seed)).block_until_ready()

    return make


serve(
    {
        "double_well/value": deterministic(ekf),
        "double_well/gradient": lambda: gradient(),
        "double_well/enkf/1250": estimate(enkf, 1250),
        "double_well/bootstrap/1000": estimate(bootstrap, 1000),
        "double_well/bootstrap/1250": estimate(bootstrap, 1250),
    },
    "cuthbert",
    "jax",
)
