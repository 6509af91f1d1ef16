"""dynamax: its extended Kalman filter, jitted, for the log-likelihood only.

It does not support missing observations. At the 1900 steps without one the observation is zero with
the variance ``HUGE``, which changes nothing by more than rounding. The log-density of those zeros,
a constant, is subtracted.
"""

import numpy as np

from benchmarks.peers.serve import every_step, record, serve

import jax.numpy as jnp  # isort: skip  # after serve, which sets its options
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

from benchmarks.peers import jax_systems

HUGE = 1e12


def task(name: str, gradient: bool):
    theta, steps, inputs, observed = record(name)
    rows = every_step(steps, observed)
    missing = np.isnan(rows[:, 0])
    # Step t of dynamax predicts with the input of step t + 1.
    inputs = jnp.concatenate([jnp.zeros(1), inputs])[: len(rows), None]
    offset = 0.5 * missing.sum() * np.log(2.0 * np.pi * HUGE)

    def double_well(theta):
        return {
            "initial_mean": jnp.array([1.0]),
            "initial_covariance": jnp.array([[0.5]]),
            "dynamics_function": lambda x: jax_systems.double_well_step(theta, x),
            "dynamics_covariance": jax_systems.double_well_noise(theta),
            "emission_function": lambda x: x[:1],
        }, theta[3]

    def mass_spring_damper(theta):
        return {
            "initial_mean": jnp.array([theta[8], 0.0]),
            "initial_covariance": 0.1 * jnp.eye(2),
            "dynamics_function": lambda x, u: jax_systems.mass_spring_damper_step(theta, x, u[0]),
            "dynamics_covariance": jax_systems.mass_spring_damper_noise(theta),
            "emission_function": lambda x, u: x[:1],
        }, theta[7]

    def value(theta):
        model, gamma = (double_well if name == "double_well" else mass_spring_damper)(theta)
        R = jnp.where(missing, HUGE, gamma)[:, None, None]
        result = extended_kalman_filter(
            ParamsNLGSSM(**model, emission_covariance=R),
            jnp.nan_to_num(rows),
            inputs=None if name == "double_well" else inputs,
            output_fields=["marginal_loglik"],
        )
        loglik = result.marginal_loglik
        return (loglik if loglik.ndim == 0 else loglik[-1]) + offset

    return lambda: jax_systems.call_of(value, theta, gradient)


serve(jax_systems.tasks_of(task), "dynamax", "jax")
