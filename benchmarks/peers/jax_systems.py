"""One step of the systems as functions of a state vector, for the packages that run on JAX."""

import jax.numpy as jnp

DT = 0.01


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
