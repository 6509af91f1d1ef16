"""The systems of the tests: a few, each of which serves many, so that machine code is shared.

Systems whose equations differ in numbers only run the same machine code if these numbers are
parameters: here nearly all are, with defaults. A test of other numbers gives other values, or makes
a system with other defaults, and compiles nothing. Another constant, state or step is another
graph, and is compiled for each filter anew.
"""

from functools import cache

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import DoubleWell, LinearSystem

STEPS = np.array([0, 2, 3, 6])
# A missing component, and a row wholly missing.
PAIR_DATA = np.array([[0.1, 0.2], [np.nan, 0.3], [np.nan, np.nan], [0.5, -0.1]])
FORCED_DATA = np.array([0.1, -0.4, np.nan, 0.9])
FORCE = np.array([0.5, -0.2, 0.1, 0.3, 0.0, -0.4])


# Linear systems, exact by Kalman's formulas.


def pair(**changes):
    """Two coupled states, two observables; `b` has the default 0.2."""
    settings = {
        "transition": lambda x, q, a, b=0.2: [a * x[0] + b * x[1] + q[0], 0.8 * x[1] + q[1]],
        "process_noise": [[1.0, 0.0], [0.0, 0.5]],
        "observation": lambda x: [x[0], x[1]],
        "observation_noise": [[0.5, 0.1], [0.1, 0.4]],
        "initial_mean": [0.0, 0.3],
        "initial_cov": [[1.0, 0.0], [0.0, 2.0]],
        "observables": ["position", "speed"],
    }
    return psf.StateSpaceModel(**settings | changes)


def forced(**changes):
    """One state, pushed by an input."""
    settings = {
        "transition": lambda x, q, u, a: [a * x[0] + u[0] + q[0]],
        "process_noise": [[1.0]],
        "observation": lambda x: [x[0]],
        "observation_noise": [[0.5]],
        "initial_mean": [0.0],
        "initial_cov": [[1.0]],
        "inputs": ["force"],
    }
    return psf.StateSpaceModel(**settings | changes)


PAIR = pair()
FORCED = forced()
# The system of most examples in docstrings.
FREE = forced(transition=lambda x, q, a: [a * x[0] + q[0]], inputs=())


def pair_terms(a, b=0.2, observed=PAIR_DATA, steps=STEPS):
    """The exact terms log p(d_j | d_1 .. d_{j-1}) of PAIR."""
    return kalman_log_likelihood(
        np.array([[a, b], [0.0, 0.8]]),
        np.diag([1.0, 0.5]),
        np.eye(2),
        np.array([[0.5, 0.1], [0.1, 0.4]]),
        np.array([0.0, 0.3]),
        np.diag([1.0, 2.0]),
        observed=observed,
        steps=steps,
    )


def forced_terms(
    a, observed=FORCED_DATA, steps=STEPS, force=FORCE, observation_noise=0.5, initial_cov=1.0
):
    """The exact terms of FORCED, or of one with other constants."""
    return kalman_log_likelihood(
        [[a]],
        [[1.0]],
        [[1.0]],
        [[observation_noise]],
        [0.0],
        [[initial_cov]],
        observed=observed,
        steps=steps,
        forcing=np.reshape(force, (-1, 1)),
    )


def autoregression(
    *, spread=None, observation_noise=0.4, initial_mean=0.0, initial_var=1.0, **changes
):
    """x' = phi x + q with the sd ``spread`` of q, a parameter of a default only if one is given.

    The variances of the sensor and of the start and the mean of the start are parameters, too.
    """

    def spread_squared(spread):
        return [[spread**2]]

    def spread_squared_by_default(spread=spread):
        return [[spread**2]]

    settings = {
        "transition": lambda x, q, phi: [phi * x[0] + q[0]],
        "process_noise": spread_squared if spread is None else spread_squared_by_default,
        "observation": lambda x: [x[0]],
        "observation_noise": lambda observation_noise=observation_noise: [[observation_noise]],
        "initial_mean": lambda initial_mean=initial_mean: [initial_mean],
        "initial_cov": lambda initial_var=initial_var: [[initial_var]],
    }
    return psf.StateSpaceModel(**settings | changes)


def wandering_mean():
    """A mean mu at the start that walks at random, with unit noise of the sensor."""
    return psf.StateSpaceModel(
        transition=lambda x, q, mu_strength: [x[0] + mu_strength * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=lambda mu: [mu],
        initial_cov=[[0.0]],
    )


def driven(**changes):
    """x' = a x + gain u + q, with the noises and the mean of the start as parameters."""
    settings = {
        "transition": lambda x, q, u, a, gain: [a * x[0] + gain * u[0] + q[0]],
        "process_noise": lambda sigma: [[sigma**2]],
        "observation": lambda x: [x[0]],
        "observation_noise": lambda sensor=0.2: [[sensor]],
        "initial_mean": lambda start=0.0: [start],
        "initial_cov": [[0.1]],
        "inputs": ["force"],
    }
    return psf.StateSpaceModel(**settings | changes)


def driven_by_wandering_gain():
    """The same with a gain that walks at random from its value at the start."""
    return driven(
        transition=lambda x, q, u, a, strength: [
            a * x[0] + x[1] * u[0] + q[0],
            x[1] + strength * q[1],
        ],
        process_noise=lambda sigma: [[sigma**2, 0.0], [0.0, 1.0]],
        initial_mean=lambda gain: [0.0, gain],
        initial_cov=[[0.1, 0.0], [0.0, 0.0]],
    )


def simulated(steps, random_seed, phi, spread, observation_noise=0.4):
    """A record (J,) of `autoregression`, by NumPy: importing a test file must compile nothing."""
    rng = np.random.default_rng(random_seed)
    x, observed = rng.standard_normal(), []
    for k in range(steps[-1] + 1):
        if k in steps:
            observed.append(x + np.sqrt(observation_noise) * rng.standard_normal())
        x = phi * x + spread * rng.standard_normal()
    return np.array(observed)


@cache
def linear_system(reference: LinearSystem, carried: tuple[str, ...] = ()) -> psf.StateSpaceModel:
    """x' = A x + B q and d = C x + e; the matrices are parameters with defaults.

    A covariance must be symmetric at any values of its parameters.
    """
    given = vars(reference)

    def transition(x, q, A=given["A"], B=given["B"]):
        return A @ x + B @ q

    return psf.StateSpaceModel(
        transition=transition,
        process_noise=np.eye(reference.B.shape[1]),
        observation=lambda x, C=given["C"]: C @ x,
        observation_noise=lambda R=given["R"]: (R + R.T) / 2,
        initial_mean=lambda mean=given["mean"]: mean,
        initial_cov=lambda cov=given["cov"]: (cov + cov.T) / 2,
        shapes={name: np.shape(value) for name, value in given.items()},
        carried=carried,
    )


# A particle in a double well.


def drift(x, alpha, beta):
    """Force of the double well."""
    return [alpha * x[0] + beta * x[0] ** 3]


def diffusion(sigma):
    """Noise per square root of time."""
    return [[sigma]]


DOUBLE_WELL_SYSTEM = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=DoubleWell.dt),
    observation=lambda x: [x[0]],
    observation_noise=lambda noise_var: [[noise_var]],
    initial_mean=lambda initial_mean: [initial_mean],
    initial_cov=lambda initial_var: [[initial_var]],
)


def double_well_parameters(reference: DoubleWell) -> dict[str, float]:
    """The values that the record was simulated with."""
    return {name: getattr(reference, name) for name in DOUBLE_WELL_SYSTEM.parameters}


# A Duffing oscillator: noise on the velocity, a sensor that bends, and a start known where v is 0.
DUFFING = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x, k, c: [x[1], -k * x[0] - x[0] ** 3 - c * x[1]], lambda s: [[0.0], [s]], dt=0.1
    ),
    observation=lambda x, b: [x[0] + b * x[0] ** 2, x[1]],
    observation_noise=lambda r: [[r, 0.06], [0.06, 0.4]],
    initial_mean=lambda m: [m, 0.0],
    initial_cov=lambda v: [[v, 0.2 * v], [0.2 * v, 2.0 * v]],
)


# Counts of one state.


def counts(*, a=0.8, bend=0.0, level=0.0, noise_var=0.2, initial_mean=0.0, initial_var=0.5):
    """Poisson counts of mean exp(level + x), where x' = a x + bend sin x + q."""

    def transition(x, q, a=a, bend=bend):
        return [a * x[0] + bend * pt.sin(x[0]) + q[0]]

    return psf.StateSpaceModel(
        transition=transition,
        process_noise=lambda noise_var=noise_var: [[noise_var]],
        observation_dist=lambda x, level=level: [pm.Poisson.dist(mu=pt.exp(level + x[0]))],
        initial_mean=lambda initial_mean=initial_mean: [initial_mean],
        initial_cov=lambda initial_var=initial_var: [[initial_var]],
    )


def log_likelihoods(system, filter, params, seeds, **record):
    """Total log-likelihoods (n_seeds,) of a filter with noise, without a warning."""
    run = evaluator(LogLikelihood(system, filter))
    arguments = (
        flat_parameters(system, params),
        *read_record(system, GivenRecord(**record)).arguments,
    )
    return np.array([run(*arguments, seed)[0].sum() for seed in seeds])
