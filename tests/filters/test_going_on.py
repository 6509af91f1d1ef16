"""GuidedPF and GridFilter that go on from a state, and members that are divided between ranks."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from benchmarks.corpus import CASES
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.signatures import LIKELIHOOD, SEEDED, Signature
from pymc_statespace_filters.pymc_model.filter_rows import FilterRows, Record
from tests.ranks import on_ranks

NO_INPUTS = np.zeros((0, 0))


def arguments(case):
    """Parameters and record of a case, as machine code has them."""
    theta = np.array([case.params[name] for name in case.system.parameters])
    inputs = NO_INPUTS if case.inputs is None else case.inputs
    return theta, Record(case.steps, case.observed, inputs, np.asarray(0.0))


def log_mean(values):
    """Log of the mean of exponentials, and its standard error."""
    largest = values.max()
    w = np.exp(values - largest)
    return largest + np.log(w.mean()), w.std() / w.mean() / np.sqrt(w.size)


# A start of which no row tells, and one at which the record is cut; rows that are missing in part.
FIRST_MISSING = np.array([[np.nan, np.nan], [0.5, np.nan], [np.nan, np.nan], [1.9, 0.4]])


@pytest.mark.parametrize("name", ["linear", "linear, first row missing", "hopping"])
def test_estimates_of_a_guided_filter_are_unbiased_in_parts(name):
    """Of 4000 seeds, within 4.5 errors: row by row, where each guide sees one row."""
    case = CASES[name.split(",")[0]]
    theta, record = arguments(case)
    if "first" in name:
        record = record._replace(steps=np.array([2, 5, 6, 9]), observed=FIRST_MISSING)
    seeds = np.arange(4000)
    rows = FilterRows(case.system, psf.GuidedPF(32))
    nothing = np.empty((seeds.size, 0))
    terms, states = rows(np.tile(theta, (seeds.size, 1)), seeds, nothing, record)
    found, error = log_mean(terms.sum(axis=1))
    exact = evaluator(LogLikelihood(case.system, psf.EKF() if name != "hopping" else MANY))
    truth = exact(theta, *record, np.int64(1))[0].sum()
    assert abs(found - truth) < 4.5 * error + (0.02 if name == "hopping" else 0.0)
    assert error < 0.02
    assert (states[:, 0] == record.steps[-1]).all()


MANY = psf.BootstrapPF(100_000)


def test_parts_at_once_are_parts_in_turn():
    """A record in one call has the bits of its rows in several."""
    case = CASES["hopping"]
    theta, record = arguments(case)
    rows, seeds = FilterRows(case.system, psf.GuidedPF(64)), np.arange(3)
    many = np.tile(theta, (3, 1))
    whole, end = rows(many, seeds, np.empty((3, 0)), record)
    first, states = rows(many, seeds, np.empty((3, 0)), record.rows(0, 2))
    second, left = rows(many, seeds, states, record.rows(2, 4))
    np.testing.assert_array_equal(np.hstack([first, second]), whole)
    np.testing.assert_array_equal(left, end)


def test_points_that_fail_on_the_way_have_no_likelihood_and_no_state():
    case = CASES["linear"]
    theta, record = arguments(case)
    rows = FilterRows(case.system, psf.GuidedPF(32))
    many = np.stack([theta, np.where(case.system.parameters == np.array("r"), -2.0, theta)])
    terms, states = rows(many, np.arange(2), np.empty((2, 0)), record)
    assert np.isfinite(terms[0]).all()
    assert np.isneginf(terms[1]).all()
    assert np.isfinite(states[0]).all()
    assert np.isnan(states[1]).all()


def vanishing():
    """Noise that vanishes at zero, which the state passes: segments."""
    return psf.StateSpaceModel(
        transition=lambda x, q, s: [x[0] + 0.1 * (1 - x[0]) + s * x[0] * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[1.0],
        initial_cov=[[0.1]],
    )


def damped():
    """Noise that an input makes fifty times smaller: a grid that is too coarse then."""
    return psf.StateSpaceModel(
        transition=lambda x, q, u: [0.9 * x[0] + u[0] * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.5]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        inputs=["size"],
    )


def known_start():
    """A start without spread, still there when the record is cut."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [np.cos(1.0) * x[0] + 0.3 * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.5]],
        initial_mean=[0.4],
        initial_cov=[[0.0]],
    )


EVERY_SECOND = np.arange(0, 28, 2)
SMALLER = np.where(np.arange(30) < 14, 1.0, 0.02)[:, np.newaxis]
ON_GRIDS = {
    "vanishing noise": (vanishing, {"s": 0.2}, EVERY_SECOND[1:], None),
    "smaller noise": (damped, {}, EVERY_SECOND, SMALLER),
    "known start": (known_start, {}, EVERY_SECOND, None),
}


@pytest.mark.parametrize("name", [*ON_GRIDS, "surprise", "double well"])
def test_a_grid_goes_on_within_its_tolerance(name):
    """Wherever the record is cut, and with a cut behind every row."""
    if name == "double well":
        case = CASES[name]
        system, params, steps, inputs = case.system, case.params, case.steps, None
        observed = case.observed
    else:
        build, params, steps, inputs = ON_GRIDS["smaller noise" if name == "surprise" else name]
        system = build()
        given = psf.simulate(system, params, steps=steps, inputs=inputs, random_seed=1)
        observed = given["observations"].values.copy()
        observed[3] = np.nan
        if name == "surprise":
            observed[12] = 9.0

    def run(rows, state=None):
        return psf.run_filter(
            system, psf.GridFilter(), params, observed[rows], steps=steps[rows], inputs=inputs,
            state=state,
        )  # fmt: skip

    whole = run(slice(None))
    alone = psf.log_likelihood(
        system, psf.GridFilter(), params, observed, steps=steps, inputs=inputs
    )
    np.testing.assert_allclose(whole["log_likelihood"], alone, atol=1e-8)
    for cuts in ([1], [4], [steps.size // 2], range(1, steps.size)):
        parts, ends = [], [*cuts, steps.size]
        for first, last in zip([0, *cuts], ends, strict=True):
            parts.append(run(slice(first, last), parts[-1] if parts else None))
        for what in ("log_likelihood", "mean", "sd"):
            joined = np.concatenate([part[what] for part in parts])
            np.testing.assert_allclose(joined, whole[what], atol=1e-8)


class RankedRun(LogLikelihood):
    """The likelihood from a state, and the state left, with members of several ranks."""

    signature = Signature(
        (*SEEDED, ("state", 1), ("rank", 0), ("n_ranks", 0), ("exchange", 0)),
        (*LIKELIHOOD.results, ("state", 1)),
    )
    is_collective = True


FILTERS = [psf.EnKF(130), psf.PFEnKF(130), psf.BootstrapPF(200), psf.GuidedPF(200)]


@pytest.mark.parametrize("filter", FILTERS, ids=repr)
def test_ranks_leave_and_take_the_state_of_one(filter):
    case = CASES["hopping"]
    theta, record = arguments(case)
    evaluate = evaluator(RankedRun(case.system, filter))

    def together(rows, state, n_ranks):
        def own(rank):
            call = theta, *rows, np.int64(7), state, rank.rank, rank.size, rank.exchange
            found = evaluate(*call)
            rank.check_exchange()
            return found

        return on_ranks(n_ranks, own)

    ((terms, _, state),) = together(record.rows(0, 2), np.empty(0), 1)
    ((later, _, end),) = together(record.rows(2, 4), state, 1)
    for found in together(record.rows(0, 2), np.empty(0), 2):
        np.testing.assert_array_equal(found[0], terms)
        np.testing.assert_array_equal(found[2], state)
    for found in together(record.rows(2, 4), state, 2):
        np.testing.assert_array_equal(found[0], later)
        np.testing.assert_array_equal(found[2], end)
