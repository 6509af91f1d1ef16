"""The extended Kalman filters written by hand in JAX: two nested scans, jitted, in float64.

Every step of the double well is scalar arithmetic; that of the mass-spring-damper is written out
too, as in ``loops.py``. The inner scan runs over the steps between two observations.
"""

import numpy as np

from benchmarks.peers.serve import record, serve

import jax  # isort: skip  # after serve, which sets its options
import jax.numpy as jnp

from benchmarks.peers import jax_systems

DT = 0.01
# Steps unrolled at a time: the fastest of 1, 2, 4, 5, 10 and 20 for each task.
UNROLL = {
    "double_well/value": 4,
    "double_well/gradient": 4,
    "mass_spring_damper/value": 4,
    "mass_spring_damper/gradient": 1,
}


def double_well(theta, gaps, observed, unroll):
    alpha, beta, sigma, gamma = theta
    noise = DT * (0.36 + sigma**2)

    def step(state, _):
        x, P = state
        a = 1.0 + DT * (alpha + 3.0 * beta * x * x)
        return (x + DT * (alpha * x + beta * x * x * x), a * P * a + noise), None

    def update(x, P, d):
        S, v = P + gamma, d - x
        K = P / S
        return (x + K * v, (1.0 - K) * P), -0.5 * (jnp.log(2.0 * jnp.pi * S) + v * v / S)

    def cycle(state, d):
        state, _ = jax.lax.scan(step, state, length=gaps, unroll=unroll)
        return update(*state, d)

    state, first = update(1.0, 0.5, observed[0])
    return first + jax.lax.scan(cycle, state, observed[1:])[1].sum()


def mass_spring_damper(theta, gaps, observed, inputs, unroll):
    c, c3, k, k2, k3, gain, sigma, gamma, x0 = theta
    noise = DT * sigma**2

    def step(state, u):
        x, v, P00, P01, P11 = state
        a = -DT * (k + 2.0 * k2 * x + 3.0 * k3 * x * x)
        b = 1.0 - DT * (c + 3.0 * c3 * v * v)
        rate = gain * u - c * v - c3 * v * v * v - k * x - k2 * x * x - k3 * x * x * x
        Q00, Q01 = P00 + DT * P01, P01 + DT * P11
        Q10, Q11 = a * P00 + b * P01, a * P01 + b * P11
        P = Q00 + DT * Q01, a * Q00 + b * Q01, a * Q10 + b * Q11 + noise
        return (x + DT * v, v + DT * rate, *P), None

    def update(state, d):
        x, v, P00, P01, P11 = state
        S, r = P00 + gamma, d - x
        K0, K1 = P00 / S, P01 / S
        state = x + K0 * r, v + K1 * r, (1.0 - K0) * P00, (1.0 - K0) * P01, P11 - K1 * P01
        return state, -0.5 * (jnp.log(2.0 * jnp.pi * S) + r * r / S)

    def cycle(state, data):
        u, d = data
        return update(jax.lax.scan(step, state, u, unroll=unroll)[0], d)

    state, first = update((x0, 0.0, 0.1, 0.0, 0.1), observed[0])
    u = inputs[: gaps * (observed.size - 1)].reshape(-1, gaps)
    return first + jax.lax.scan(cycle, state, (u, observed[1:]))[1].sum()


def task(name: str, gradient: bool):
    theta, steps, inputs, observed = record(name)
    gaps = int(np.diff(steps)[0])
    unroll = UNROLL[f"{name}/{'gradient' if gradient else 'value'}"]

    def make():
        if name == "double_well":

            def value(theta):
                return double_well(theta, gaps, observed[:, 0], unroll)
        else:

            def value(theta):
                return mass_spring_damper(theta, gaps, observed[:, 0], inputs, unroll)

        return jax_systems.call_of(value, theta, gradient)

    return make


serve(jax_systems.tasks_of(task), "jax")
