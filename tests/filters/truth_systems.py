"""The systems of the reference records, written as a user of the package writes them."""

import numpy as np

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import checked_record
from tests.references.records import DoubleWell, LinearSystem


def linear_system(reference: LinearSystem) -> psf.StateSpaceModel:
    """x' = A x + B q and d = C x + e, without parameters."""
    A, B, C = reference.A, reference.B, reference.C
    return psf.StateSpaceModel(
        transition=lambda x, q: A @ x + B @ q,
        process_noise=np.eye(B.shape[1]),
        observation=lambda x: C @ x,
        observation_noise=reference.R,
        initial_mean=reference.mean,
        initial_cov=reference.cov,
    )


def drift(x, alpha, beta):
    """Force of the double well."""
    return [alpha * x[0] + beta * x[0] ** 3]


def diffusion(sigma):
    """Noise per square root of time."""
    return [[sigma]]


# One system for every double well of the reference records, so that a filter compiles once for all.
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


def log_likelihoods(system, filter, params, seeds, **record):
    """Total log-likelihoods (n_seeds,) of a filter with noise, without its warnings."""
    run = filter.compile(compile_system(system))
    settings = {"times": None, "inputs": None, "t0": 0.0} | record
    steps, observed, inputs, t0 = checked_record(system, **settings)
    arguments = (flat_parameters(system, params), steps, observed, inputs, t0.item())
    return np.array([run(*arguments, (seed, np.empty(0)))[0].sum() for seed in seeds])
