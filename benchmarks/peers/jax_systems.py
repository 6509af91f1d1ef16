"""Shared code of the packages that run on JAX: the systems' steps, jitted calls, task names."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

DT = 0.01


def call_of(value: Callable, theta, gradient: bool) -> Callable:
    """Return the value at theta, or value and gradient, jitted; the seed is not used."""
    run = jax.jit(jax.value_and_grad(value) if gradient else value)
    if gradient:
        return lambda seed: jax.block_until_ready(run(theta))[0]
    return lambda seed: run(theta).block_until_ready()


def tasks_of(task: Callable) -> dict[str, Callable]:
    """Return ``task(name, gradient)`` of both systems, with the benchmark's names."""
    return {
        f"{name}/{what}": task(name, what == "gradient")
        for name in ("double_well", "mass_spring_damper")
        for what in ("value", "gradient")
    }


def double_well_step(theta, x):
    alpha, beta, _, _ = theta
    return x + DT * (alpha * x + beta * x**3)


def double_well_noise(theta):
    """Covariance of one step."""
    return DT * (0.36 + theta[2] ** 2) * jnp.eye(1)


def mass_spring_damper_step(theta, s, u):
    c, c3, k, k2, k3, gain, _, _, _ = theta
    x, v = s
    rate = gain * u - c * v - c3 * v**3 - k * x - k2 * x**2 - k3 * x**3
    return jnp.stack([x + DT * v, v + DT * rate])


def mass_spring_damper_noise(theta):
    return jnp.diag(jnp.array([0.0, 1.0])) * DT * theta[6] ** 2
