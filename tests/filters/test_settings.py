"""Settings of filters that cannot be, as (filter, argument, value, message)."""

from functools import partial

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from tests.systems import FREE


def each(make, argument, values, message):
    """A row for each value."""
    return [(make, argument, value, message) for value in values]


PARTICLE_FILTERS = (psf.BootstrapPF, psf.PFEnKF, psf.GuidedPF)
TABLE = [
    *each(
        psf.EnKF,
        "n_members",
        [1, 0, -3, 10.0, True, "10", None, np.float64(50)],
        "n_members must be an integer from 2 to 1e.08",
    ),
    *each(
        partial(psf.EnKF, 10),
        "likelihood",
        ["Ensemble", "predictive", "exact", None, 3, ["ensemble"]],
        "likelihood must be one of 'ensemble', 'gaussian'",
    ),
    *each(
        partial(psf.PFEnKF, 10),
        "likelihood",
        ["ensemble", "gaussian", "as_printed"],
        "likelihood must be one of 'predictive', 'weights'",
    ),
]
for filter in PARTICLE_FILTERS:
    TABLE += [
        *each(
            filter,
            "n_particles",
            [0, 1, 2.5, 10.0, True, "10"],
            "n_particles must be an integer from 2 to 1e.08",
        ),
        *each(
            partial(filter, 10),
            "resample_below",
            [-0.1, 1.1, 2, np.nan, True, "0.5", None],
            "resample_below must be a number from 0 to 1",
        ),
        *each(
            partial(filter, 10),
            "resampling",
            ["none", "residual"],
            "resampling must be one of 'systematic', 'multinomial', 'sorted'",
        ),
    ]
TABLE += [
    *each(
        psf.GridFilter,
        "tolerance",
        [0.0, 0.1, -1e-8, np.nan, "1e-8", True],
        "tolerance must be a number from 1e-12 to 1e-2",
    ),
    *each(psf.UKF, "alpha", [0.0], "^alpha must be a positive number"),
    *each(psf.UKF, "beta", [np.nan], "^beta must be a finite number"),
    *each(psf.UKF, "kappa", ["3"], "^kappa must be a finite number"),
    *each(
        lambda kappa: psf.UKF(kappa=kappa).check(compile_system(FREE)),
        "kappa",
        [-1.0],
        "^kappa must be above -1 for 1 states",
    ),
    *each(psf.IPLF, "n_iterations", [0], "^n_iterations must be an integer of at least 1"),
]


@pytest.mark.parametrize(("make", "argument", "value", "message"), TABLE)
def test_wrong_settings_are_named_with_their_values(make, argument, value, message):
    with pytest.raises(psf.errors.ModelError, match=f"{message}, got ") as caught:
        make(**{argument: value})
    assert str(caught.value).removesuffix(".").endswith(f"got {value!r}")


def test_a_number_beyond_memory_is_refused():
    with pytest.raises(psf.errors.ModelError, match=r"n_particles .*to 1e.08"):
        psf.BootstrapPF(10**30)


@pytest.mark.parametrize("filter", [*PARTICLE_FILTERS, psf.RBPF])
def test_only_the_number_of_particles_is_given_by_position(filter):
    with pytest.raises(TypeError, match="positional argument"):
        filter(10, 0.5)
