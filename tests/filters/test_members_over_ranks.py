"""Filters over ranks: the same bits for any number of ranks, and sums that are the exact ones."""

import math
from itertools import pairwise

import numpy as np
import pymc as pm
import pytest
from numba import njit

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.numerics.normals import fill_normals
from pymc_statespace_filters.compiler.numerics.philox import INITIAL, PROCESS
from pymc_statespace_filters.filters import BootstrapPF, EnKF, GuidedPF, PFEnKF
from pymc_statespace_filters.filters.ensemble.reductions import (
    BLOCKS,
    MEMBERS,
    RankLayout,
    allgather_sums,
    count,
    local_partition,
    local_range,
    sum_spread,
    total,
    weighted_cov,
    weighted_mean,
)
from pymc_statespace_filters.filters.ensemble.resampling import SCHEMES
from pymc_statespace_filters.filters.ensemble.weights import normalise_weights
from pymc_statespace_filters.filters.outcomes import NONE, STATE_NOT_FINITE, ZERO_DENSITY
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.distributed import (
    DistributedLogLikelihood,
    check_ranks,
    distributed_evaluator,
)
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record
from tests.filters.ensemble_contract import (
    LINE,
    LOST_START,
    OSCILLATOR,
    PLAIN_START,
    WELL,
    WILD_START,
    arguments,
    linear,
    normals,
    well,
    well_record,
    written,
)
from tests.ranks import on_ranks
from tests.references.records import BROAD_DOUBLE_WELL, broad_double_well, simulate
from tests.systems import (
    FORCE,
    FORCED,
    FORCED_DATA,
    STEPS,
    double_well_parameters,
    linear_system,
)

NUMBERS = (1, 2, 3, 4)
N = 300  # members: four whole blocks, and a part of one
IN_THE_WELL = [EnKF(N), EnKF(N, likelihood="gaussian"), BootstrapPF(N), PFEnKF(N)]


def space_record():
    """Four states, of which the third is carried and the last, a clock, is known exactly."""
    system = linear(
        A=np.diag([0.9, 0.8, 0.7, 1.0]),
        B=np.vstack([0.3 * np.eye(3), np.zeros(3)]),
        C=np.eye(2, 4),
        R=0.1 * np.eye(2),
        mean=[0.0, 0.0, 0.0, 7.1],
        root=np.diag([1.0, 1.0, 1.0, 0.0]),
    )
    steps = np.arange(5)
    observed = simulate(system, steps, np.random.default_rng(1))
    return linear_system(system, carried=("x2",)), steps, observed


def broad_well_record():
    steps, observed = (values[:8] for values in broad_double_well())
    theta = flat_parameters(WELL, double_well_parameters(BROAD_DOUBLE_WELL))
    return WELL, steps, observed[:, None], theta


def on_ranks_alike(call, numbers=NUMBERS):
    """What ``call(rank)`` returns, the same terms and health on all of several ranks."""
    (terms, health), *others = [found for n in numbers for found in on_ranks(n, call)]
    for terms_there, health_there in others:
        assert np.array_equal(terms_there, terms)
        assert np.array_equal(health_there, health)
    return terms, health


def everywhere(filter_, system, steps, observed, theta=None, seed=3, numbers=NUMBERS):
    """Terms and health, the same on every rank for several numbers of ranks."""
    evaluate = evaluator(DistributedLogLikelihood(written(system), filter_))
    given = (*arguments(system, steps, observed, theta), seed)
    return on_ranks_alike(
        lambda ours: evaluate(*given, ours.rank, ours.size, ours.exchange), numbers
    )


# ---- the division


@pytest.mark.parametrize("per_block", [MEMBERS, BLOCKS])
@pytest.mark.parametrize("n", [1, 63, 64, 65, 128, 1000, 1250])
def test_every_column_belongs_to_one_rank_and_ranks_to_whole_blocks(n, per_block):
    n_blocks = -(-n // per_block)
    for size in {1, 2, 3, 7, n_blocks} & set(range(1, n_blocks + 1)):
        ends = [
            local_range.py_func(RankLayout(rank, size, 0), n, per_block) for rank in range(size)
        ]
        assert ends[0][0] == 0
        assert ends[-1][1] == n
        assert all(before[1] == after[0] for before, after in pairwise(ends))
        lengths = [last - first for first, last in ends]
        assert min(lengths) > 0
        assert max(lengths) < min(lengths[:-1] or lengths) + 2 * per_block
        assert all(first % per_block == 0 for first, _ in ends)


def test_normals_of_a_part_are_those_of_the_whole():
    whole, few = np.empty((2, 256)), np.empty((2, 128))
    fill_normals(5, PROCESS, 7, whole)
    fill_normals(5, PROCESS, 7, few, 1)
    assert np.array_equal(few, whole[:, 64:192])


# ---- sums


@njit(error_model="numpy", nogil=True)
def all_sums(rank, n_ranks, address, w, X, log_w):
    """Sums of the local part of w, X and log_w, by way of the ranks' exchange."""
    local = local_partition(RankLayout(rank, n_ranks, address), w.size, 12)
    mine = slice(local.first, local.first + local.size)
    v, Y, out, log_v = w[mine].copy(), X[:, mine].copy(), np.empty(9), log_w[mine].copy()
    relative, zeros, products = np.empty(v.size), np.zeros(2), np.empty((2, 1))
    out[0] = count(v, local)
    sum_spread(v, local, 0)
    allgather_sums(local, 1)
    out[1] = total(local, 0)
    weighted_mean(v, Y, 1.0, local, out[2:4])
    weighted_cov(v, Y, zeros, Y[:1], zeros, 1.0, local, products)
    out[4], out[5] = products[0, 0], products[1, 0]
    out[6], out[7] = normalise_weights(log_v, relative, local)
    out[8] = count(relative, local)
    return out


@pytest.mark.parametrize("n", [250, 256, 331])
def test_sums_are_those_of_exact_arithmetic_and_the_same_on_any_number_of_ranks(n):
    rng = np.random.default_rng(n)
    w, X = rng.uniform(size=n) / n, rng.standard_normal((2, n))
    w[70:140] = 0.0
    X[:, 75] = np.nan
    log_w = 300 * rng.standard_normal(n)  # some blocks weigh nothing beside others
    log_w[:64], log_w[200], log_w[201] = -np.inf, np.nan, np.inf
    sums = [
        out
        for size in NUMBERS
        for out in on_ranks(
            size, lambda ours: all_sums(ours.rank, ours.size, ours.exchange, w, X, log_w)
        )
    ]
    assert all(np.array_equal(other, sums[0]) for other in sums)
    alive = w > 0
    v, Y = w[alive], X[:, alive]
    exact = [math.fsum(v), math.fsum(v * (1 - v)), *(math.fsum(v * y) for y in Y)]
    exact += [math.fsum(v * y * Y[0]) for y in Y]
    assert sums[0][:6] == pytest.approx(exact, rel=1e-13, abs=1e-15)
    finite = log_w[np.isfinite(log_w)]
    weights = np.exp(finite - finite.max())
    assert sums[0][6] == pytest.approx(finite.max() + math.log(math.fsum(weights)), rel=1e-14)
    assert sums[0][7] == pytest.approx(math.fsum(weights) ** 2 / math.fsum(weights**2), rel=1e-13)
    assert sums[0][8] == pytest.approx(1, rel=1e-13)


# ---- whole filters


LIKELIHOODS = ("predictive", "weights")
CASES = [
    (EnKF(N), OSCILLATOR, NUMBERS),
    (EnKF(N, likelihood="gaussian"), OSCILLATOR, NUMBERS),
    *((BootstrapPF(N, resample_below=b), OSCILLATOR, NUMBERS) for b in (0, 1 / 3)),
    *((BootstrapPF(N, resampling=s, resample_below=1), OSCILLATOR, NUMBERS) for s in SCHEMES),
    *((PFEnKF(500, likelihood=f, resample_below=0.9), OSCILLATOR, NUMBERS) for f in LIKELIHOODS),
    *((PFEnKF(N, resampling=s, resample_below=0.9), LINE, NUMBERS) for s in SCHEMES),
    (PFEnKF(320), LINE, (1, 5)),  # as many ranks as blocks
    (PFEnKF(200), space_record(), (1, 2, 3)),  # exact sums
    *(
        (GuidedPF(N, resampling=s, resample_below=0.9), broad_well_record(), NUMBERS)
        for s in SCHEMES
    ),
]


@pytest.mark.parametrize(
    ("filter_", "record", "numbers"), CASES, ids=[str(filter_) for filter_, *_ in CASES]
)
def test_every_rank_has_the_numbers_of_one(record, numbers, filter_):
    """With missing rows and components, by all schemes and likelihoods."""
    terms, health = everywhere(filter_, *record, numbers=numbers)
    n = filter_.n_members if isinstance(filter_, EnKF) else filter_.n_particles
    seen = ~np.isnan(record[2]).all(axis=1)
    assert np.all(np.isfinite(terms))
    assert np.array_equal(terms != 0.0, seen)
    assert 1 < health[0] <= n
    assert health[1] == NONE


@pytest.mark.parametrize("filter_", IN_THE_WELL, ids=str)
def test_ranks_of_whose_members_none_is_alive(filter_):
    """A few members begin between the cliffs, none of them in the first two blocks of five."""

    def survivors(seed):
        return np.flatnonzero(np.abs(300 * normals(seed, INITIAL, 0, (1, N))[0]) < 4)

    seed = next(s for s in range(1000) if survivors(s).size > 3 and survivors(s)[0] >= 128)
    steps, observed = well_record()
    record = WELL, steps + 10, observed, well(4, -4, 0.0, 300.0)
    terms, health = everywhere(filter_, *record, seed=seed)
    assert np.all(np.isfinite(terms))
    assert health[0] < 20


@pytest.mark.parametrize("filter_", IN_THE_WELL, ids=str)
@pytest.mark.parametrize(
    ("theta", "outlier", "code"),
    [(LOST_START, 1000.0, STATE_NOT_FINITE), (PLAIN_START, 1e200, ZERO_DENSITY)],
)
def test_failures_of_all_members(filter_, theta, outlier, code):
    """Whether none is finite, or all weights are zero: every rank gives up at the same place."""
    steps, observed = well_record()
    observed[2] = outlier
    terms, health = everywhere(filter_, WELL, steps + 1, observed, theta)
    assert health[1] == code
    assert health[2] == 2 or code != ZERO_DENSITY
    assert np.all(terms[int(health[2]) :] == -np.inf)


def test_members_that_explode_on_some_ranks():
    terms, health = everywhere(PFEnKF(N), WELL, *well_record(), theta=WILD_START)
    assert np.all(np.isfinite(terms))
    assert health[1] == NONE


def test_all_weight_on_one_particle_falls_back_to_bootstrap_weights():
    # never resampled, and so precise a first observation that the second finds one particle
    observed = np.array([[80.0], [0.1], [0.2], [0.1]])
    filter_ = PFEnKF(130, resample_below=0)
    terms, health = everywhere(
        filter_, WELL, np.arange(4), observed, theta=PLAIN_START, numbers=(1, 2)
    )
    assert health[0] < 1.01
    assert np.all(np.isfinite(terms))


def by_evaluators(system, filter_, arguments):
    """Terms by the evaluator of one, two and three ranks, which are the same."""
    return on_ranks_alike(
        lambda ours: distributed_evaluator(system, filter_, ours)(*arguments), (1, 2, 3)
    )[0]


@pytest.mark.parametrize(
    "filter_",
    [EnKF(200), BootstrapPF(200, resample_below=1), GuidedPF(200)],
    ids=str,
)
def test_a_system_with_inputs_by_the_evaluator_of_one_and_of_several_ranks(filter_):
    record = np.array([0.9]), STEPS, FORCED_DATA[:, None], FORCE[:, None], 0.0, 5
    terms = by_evaluators(FORCED, filter_, record)
    alone = psf.log_likelihood(
        FORCED, filter_, {"a": 0.9}, FORCED_DATA, steps=STEPS, inputs=FORCE, seed=5
    )
    assert np.array_equal(terms, alone)


def test_counts_are_the_same_on_one_and_several_ranks():
    """Poisson, binomial and gamma noise, a start of their kind, and weekly totals."""

    def events(x, rate):
        noise = psf.compartments.gamma_white_noise(0.5, 1.0)
        return [
            pm.Poisson.dist(30.0 * noise),
            *psf.compartments.euler_multinomial(x[0], [rate], 1.0),
        ]

    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0] - q[1], x[1] + q[1]],
        process_dist=events,
        observation_dist=lambda x: [pm.Poisson.dist(x[1] + 0.1)],
        initial_dist=lambda: [pm.Poisson.dist(300.0), 0],
        states=["here", "left"],
        accumulators=["left"],
    )
    filter_, steps = BootstrapPF(200, resample_below=1), np.array([2, 4, 6])
    record = read_record(system, GivenRecord([60.0, 55.0, 70.0], steps=steps))
    arguments = np.array([0.1]), *record.arguments, 5
    terms = by_evaluators(system, filter_, arguments)
    alone = psf.log_likelihood(system, filter_, {"rate": 0.1}, record.observed, steps=steps, seed=5)
    assert np.isfinite(alone).all()
    assert np.array_equal(terms, alone)


def test_a_likelihood_has_few_exchanges():
    """They cost more than the sums: two an update, one in a particle filter, one to resample."""
    for filter_, each in ((EnKF(N), 2), (BootstrapPF(N, resample_below=1), 2)):
        evaluate = evaluator(DistributedLogLikelihood(written(OSCILLATOR[0]), filter_))

        def count(ours, evaluate=evaluate):
            evaluate(*arguments(*OSCILLATOR), 3, ours.rank, ours.size, ours.exchange)
            return len(ours.exchanged)

        n_updates = np.sum(~np.isnan(OSCILLATOR[2]).all(axis=1))
        assert on_ranks(2, count) == [each * n_updates] * 2


# ---- refusals


def test_a_filter_without_members_has_nothing_to_spread():
    for filter_ in (psf.EKF(), psf.GridFilter()):
        check_ranks(filter_, 1)
        with pytest.raises(
            psf.errors.ModelError, match=r"has no members to distribute over 2 ranks"
        ):
            check_ranks(filter_, 2)


def test_more_ranks_than_blocks_of_members():
    check_ranks(EnKF(192), 3)
    for n_members in (192, 255):  # a part of a block is no block
        with pytest.raises(psf.errors.ModelError, match=r"has members for 3 of 4 ranks only"):
            check_ranks(EnKF(n_members), 4)
