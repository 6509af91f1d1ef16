"""Every filter and likelihood approaches the exact answer, and every known fault is caught.

Two records. On the linear oscillator with gaps the exact answer is the Kalman filter's; proposals
of an ensemble Kalman update are exact there, so the weights of a PF-EnKF hardly vary and faults in
handling them are invisible. On the broad double well (truth: point-mass filter) the update is
wrong by 1.5 nats, and weights must repair it: there they are seen.
"""

from functools import cache

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.filters.convergence import Law, measure, violations
from tests.references import faulty_filters
from tests.references.faulty_filters import Fault
from tests.references.records import (
    BROAD_DOUBLE_WELL,
    OSCILLATOR,
    Record,
    broad_double_well,
    oscillator_with_gaps,
)
from tests.systems import (
    DOUBLE_WELL_SYSTEM,
    double_well_parameters,
    linear_system,
    log_likelihoods,
)

# Monte Carlo errors fall as N^(-1/2). The kernel densities of a PF-EnKF have a bias of the square
# of their bandwidth, N^(-1/3) for two states and N^(-2/5) for one.
ROOT = (-0.5, -0.5)
OSCILLATOR_LAWS = {
    "enkf": Law((250, 16_000), n_seeds=24, bias=0.01, scatter=0.07, slope=ROOT),
    "enkf_gaussian": Law((250, 16_000), n_seeds=24, bias=0.01, scatter=0.09, slope=ROOT),
    "bootstrap": Law((250, 16_000), n_seeds=24, bias=0.01, scatter=0.07, slope=ROOT),
    "pf_enkf": Law((125, 500), n_seeds=20, bias=0.05, scatter=0.30, slope=(-0.5, -0.33)),
    "pf_enkf_weights": Law((125, 500), n_seeds=20, bias=0.40, scatter=0.30, slope=(-0.5, -0.33)),
}
# The others run with the slow tests: compiling them at two sizes takes longer than running them.
QUICK = ("enkf", "bootstrap")
# The same over the whole range; the bias of the kernel densities is still there at the end.
WHOLE_RANGE = (250, 1000, 4000, 16_000)
SLOW_LAWS = {
    **{
        name: OSCILLATOR_LAWS[name]._replace(counts=WHOLE_RANGE)
        for name in ("enkf", "enkf_gaussian", "bootstrap")
    },
    "pf_enkf": Law(WHOLE_RANGE, n_seeds=6, bias=0.01, scatter=0.10, slope=(-0.5, -0.33)),
    "pf_enkf_weights": Law(WHOLE_RANGE, n_seeds=6, bias=0.15, scatter=0.10, slope=(-0.5, -0.33)),
}
# Never resampled: the weights of ten observations must be carried without a mistake.
BROAD_LAW = Law((125, 500), n_seeds=12, bias=0.30, scatter=0.30, slope=(-0.5, -0.3))

FILTERS = {
    "enkf": psf.EnKF,
    "enkf_gaussian": lambda n: psf.EnKF(n, likelihood="gaussian"),
    "bootstrap": psf.BootstrapPF,
    "pf_enkf": psf.PFEnKF,
    "pf_enkf_weights": lambda n: psf.PFEnKF(n, likelihood="weights"),
}
UPDATES = {
    "enkf": faulty_filters.enkf,
    "bootstrap": faulty_filters.bootstrap,
    "pf_enkf": faulty_filters.pf_enkf,
    "pf_enkf_weights": faulty_filters.pf_enkf_weights,
}


@cache
def oscillator_truth() -> float:
    record = oscillator_with_gaps()
    return kalman_log_likelihood(
        *OSCILLATOR.kalman_arguments(), steps=record.steps, observed=record.observed
    ).sum()


@cache
def broad_record() -> Record:
    return Record(*(rows[:10] for rows in broad_double_well()))


@cache
def broad_truth() -> float:
    return BROAD_DOUBLE_WELL.point_mass_filter().run(*broad_record()).terms.sum()


def package_errors(make_filter, system, parameters, record, truth):
    """Errors of the package's filter as a function of its size and the number of seeds."""

    def errors(count, n_seeds):
        seeds = np.arange(n_seeds)
        found = log_likelihoods(system, make_filter(count), parameters, seeds, **record._asdict())
        return found - truth

    return errors


def reference_errors(update, reference, record, truth, fault, resample_below=1 / 3):
    """The same for a reference filter with a fault."""

    def errors(count, n_seeds):
        runs = [
            faulty_filters.run(
                reference,
                record,
                update,
                count,
                np.random.default_rng([seed, count]),
                resample_below=resample_below,
                fault=fault,
            ).sum()
            for seed in range(n_seeds)
        ]
        return np.array(runs) - truth

    return errors


@pytest.mark.parametrize(
    ("name", "law"),
    [
        *((name, law) for name, law in OSCILLATOR_LAWS.items() if name in QUICK),
        *(pytest.param(name, law, marks=pytest.mark.slow) for name, law in SLOW_LAWS.items()),
    ],
)
def test_filter_approaches_kalman(name, law):
    found = measure(
        package_errors(
            FILTERS[name], linear_system(OSCILLATOR), {}, oscillator_with_gaps(), oscillator_truth()
        ),
        law,
    )
    assert violations(found, law) == []


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *((name, Fault.NONE) for name in UPDATES),
        ("enkf", Fault.UNPERTURBED_OBSERVATIONS),
        ("bootstrap", Fault.POST_UPDATE_WEIGHTS),
        ("bootstrap", Fault.WEIGHTS_FORGOTTEN),
        ("pf_enkf", Fault.POST_UPDATE_WEIGHTS),
        ("pf_enkf_weights", Fault.NO_FORECAST_DETERMINANT),
        ("pf_enkf_weights", Fault.NO_ANALYSIS_DETERMINANT),
    ],
)
def test_same_check_passes_a_right_filter_and_fails_a_wrong_one(name, fault):
    law = OSCILLATOR_LAWS[name]
    found = measure(
        reference_errors(
            UPDATES[name], OSCILLATOR, oscillator_with_gaps(), oscillator_truth(), fault
        ),
        law,
    )
    assert bool(violations(found, law)) == (fault is not Fault.NONE)


def test_pf_enkf_approaches_the_truth_where_weights_matter():
    found = measure(
        package_errors(
            lambda n: psf.PFEnKF(n, likelihood="weights", resample_below=0.0),
            DOUBLE_WELL_SYSTEM,
            double_well_parameters(BROAD_DOUBLE_WELL),
            broad_record(),
            broad_truth(),
        ),
        BROAD_LAW,
    )
    assert violations(found, BROAD_LAW) == []


@pytest.mark.parametrize(
    "fault",
    [
        Fault.NONE,
        Fault.WEIGHTS_FORGOTTEN,
        Fault.EXTRA_PREVIOUS_WEIGHT,
        Fault.NO_FORECAST_DETERMINANT,
        Fault.NO_ANALYSIS_DETERMINANT,
    ],
)
def test_same_check_fails_wrong_weights(fault):
    found = measure(
        reference_errors(
            faulty_filters.pf_enkf_weights,
            BROAD_DOUBLE_WELL,
            broad_record(),
            broad_truth(),
            fault,
            resample_below=0.0,
        ),
        BROAD_LAW,
    )
    assert bool(violations(found, BROAD_LAW)) == (fault is not Fault.NONE)
