"""Ranks that evaluate together: the leader's chain is that of one rank, and nobody waits for ever.

The ranks are threads here; `tests/mpi` has real ones.
"""

import numpy as np
import pymc as pm
import pytest
from pytensor.compile.ops import wrap_py
from pytensor.tensor import dscalar

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError, ParallelError
from pymc_statespace_filters.sampling.kernel.state import draw_key
from pymc_statespace_filters.sampling.run.chain import Chain
from pymc_statespace_filters.sampling.target import leader_follower
from pymc_statespace_filters.sampling.target.leader_follower import follow, release_followers
from pymc_statespace_filters.sampling.target.log_density import LogDensity
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.ranks import on_ranks
from tests.systems import FORCE, FORCED, FORCED_DATA, PAIR, PAIR_DATA, STEPS

ENSEMBLE, PARTICLES = psf.EnKF(192), psf.BootstrapPF(300, resample_below=0.7)
ITERATIONS = 60


def two_records(first=ENSEMBLE, second=PARTICLES):
    """Priors on all of the line and on a part, a Potential, data, two records."""
    with pm.Model() as model:
        a = pm.Normal("a", 0.3, 0.5)
        b = pm.Uniform("b", -0.5, 0.5)
        pm.Potential("pull", -((a - b) ** 4))
        pm.StudentT("y", 4, mu=a, sigma=pm.math.exp(b), observed=[0.3, 0.9, -0.2])
        psf.StateSpace("pair", PAIR, first, steps=STEPS, observed=PAIR_DATA)
        psf.StateSpace(
            "forced",
            FORCED,
            second,
            params={"a": pm.math.tanh(a)},
            steps=STEPS,
            observed=FORCED_DATA,
            inputs=FORCE,
            dims=("forced_time", "forced_place"),
        )
    return model


MODEL = two_records()


def run_chain(target):
    """Where a chain went: all its draws and where it stands."""
    target.prepare()
    rng = np.random.default_rng(5)
    key = draw_key(rng)
    chain = Chain(target, key, ITERATIONS, 0)
    chain.start(target.prior_draws.candidates(np.zeros(2), rng), (), rng)
    half = ITERATIONS // 2
    chain.advance(True, 0, 0, half)
    chain.advance(False, half, half, ITERATIONS - half)
    if not target.settings.refresh_noise:
        return chain.draws, chain.state
    spread = chain.seed_spread(np.zeros(2), np.arange(10).reshape(5, 2))
    return chain.draws, chain.state, spread


def led(ranks, lead, *arguments):
    """What ``lead(*arguments)`` gives on the first of the ranks; the others follow."""
    if ranks.rank > 0:
        return follow(ranks)
    with release_followers(ranks):
        return lead(*arguments)


SETTINGS = {
    "fresh noise": {},
    "held noise": {"refresh_noise": False},
    "screened": {"screen": psf.EKF()},
    "held screen": {"screen": psf.EnKF(64), "stages": 1},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_chain_is_that_of_one_rank(name):
    settings = RandomWalkSettings(**{"adapt_every": 10} | SETTINGS[name])
    alone = run_chain(Target(MODEL, None, settings))

    def call(ranks):
        return led(ranks, lambda: run_chain(Target(MODEL, None, settings, group=ranks))), ranks

    for size in (2, 3):
        (together, leader), *followers = on_ranks(size, call)
        for mine, theirs in zip(together, alone, strict=True):
            for values, expected in zip(mine, theirs, strict=True):
                np.testing.assert_array_equal(values, expected)
        assert together[0].counts[:, 0].any(), "the chain never moved"
        # Each did its share, and the leader not all of it alone.
        assert leader.exchanged
        for _, follower in followers:
            assert follower.exchanged == leader.exchanged


def test_a_group_of_one_is_no_group():
    def call(ranks):
        target = Target(MODEL, None, RandomWalkSettings(refresh_noise=False), group=ranks)
        target.prepare()
        density = target.density.bind()
        return density(np.zeros(2), (), target.fixed_seeds), target.density._leader

    (value, leader), *_ = on_ranks(1, call)
    assert np.isfinite(value.log_density)
    assert leader is None


def kinds_sent(ranks):
    """Note down the kinds of the messages that a rank sends from now on."""
    kinds, send = [], ranks.send

    def noting(to, kind, value=None):
        kinds.append(kind)
        send(to, kind, value)

    ranks.send = noting
    return kinds


def test_a_record_is_sent_once():
    def call(ranks):
        kinds = kinds_sent(ranks)

        def evaluate():
            target = Target(MODEL, None, RandomWalkSettings(), group=ranks)
            target.prepare()
            density = target.density.bind()
            for i in range(5):
                density(np.zeros(2), (), [i, i])
            return kinds

        return led(ranks, evaluate)

    kinds, _ = on_ranks(2, call)
    assert kinds == ["record", "evaluate"] * 2 + ["evaluate"] * 8 + ["end"]


def density_of(model, group=None):
    """The log-density of all the variables of a model."""
    point = model.initial_point(random_seed=1)
    density = LogDensity(model, model.value_vars, point, {}, group=group)
    density.prepare()
    return density.bind()


def test_a_record_that_is_itself_sampled():
    with pm.Model() as model:
        psf.StateSpace("d", PAIR, ENSEMBLE, params={"a": 0.4}, steps=[1, 3, 4])
    places = np.random.default_rng(2).normal(size=(4, 6))
    alone = density_of(model)
    expected = [alone(place, (), ()) for place in places]

    def evaluate(ranks):
        together = density_of(model, ranks)
        return [together(place, (), ()) for place in places]

    results = on_ranks(2, lambda ranks: led(ranks, evaluate, ranks))
    assert results[0] == expected
    assert len({value.log_density for value in expected}) == len(places)


def test_two_models_by_turns():
    """Each has a leader of its own in the group; followers tell their records apart."""

    def record(observed):
        with pm.Model() as model:
            pm.Normal("a")
            psf.StateSpace("d", PAIR, ENSEMBLE, steps=STEPS, observed=observed)
        return model

    models = record(PAIR_DATA), record(2.0 - PAIR_DATA)

    def evaluate(group=None):
        densities = [density_of(model, group) for model in models]
        return [density(np.full(1, a), (), ()) for a in (0.1, 0.7) for density in densities]

    together, _ = on_ranks(2, lambda ranks: led(ranks, evaluate, ranks))
    assert together == evaluate()
    assert len(set(together)) == 4


def test_other_modes_of_pytensor_call_back():
    """Where PyTensor has no machine code of its own, that of the filters is called all the same."""
    kwargs = {"mode": "FAST_COMPILE"}
    alone = Target(MODEL, None, RandomWalkSettings(), compile_kwargs=kwargs)
    alone.prepare()

    def evaluate(ranks):
        target = Target(MODEL, None, RandomWalkSettings(), compile_kwargs=kwargs, group=ranks)
        target.prepare()
        return target.density.bind()(np.ones(2), (), [3, 4])

    result, _ = on_ranks(2, lambda ranks: led(ranks, evaluate, ranks))
    assert result == alone.density.bind()(np.ones(2), (), [3, 4])


class Unlucky(RuntimeError):
    """Raised by one rank alone."""


def fail_on(rank, monkeypatch, *, at_call=3):
    """Let a rank raise in the midst of its evaluations, where the others need it."""
    distributed_evaluator = leader_follower.distributed_evaluator

    def failing(system, filter, ranks):
        evaluate, calls = distributed_evaluator(system, filter, ranks), []

        def evaluate_or_fail(*arguments):
            calls.append(arguments)
            if ranks.rank == rank and len(calls) == at_call:
                raise Unlucky(f"on rank {rank}")
            return evaluate(*arguments)

        return evaluate_or_fail

    monkeypatch.setattr(leader_follower, "distributed_evaluator", failing)


def test_followers_that_do_not_hear_are_not_left_behind(monkeypatch):
    """The leader's error in the midst of an evaluation, in which the followers wait for it."""
    fail_on(0, monkeypatch)
    monkeypatch.setattr(leader_follower, "_ANSWER_SECONDS", 0.2)
    aborted = []

    def call(ranks):
        abort = ranks.abort
        ranks.abort = lambda error: (aborted.append((ranks.rank, str(error))), abort(error))
        return led(ranks, evaluate_ten, ranks)

    with pytest.raises(Unlucky, match="on rank 0"):
        on_ranks(2, call)
    assert aborted[0] == (0, "on rank 0")


def evaluate_ten(ranks):
    target = Target(MODEL, None, RandomWalkSettings(), group=ranks)
    target.prepare()
    density = target.density.bind()
    return [density(np.zeros(2), (), [i, i]) for i in range(10)]


def evaluate_rows(ranks=None):
    """Log-densities at ten points, and what the watch hears of them."""
    target = Target(MODEL, None, RandomWalkSettings(), group=ranks)
    target.prepare()
    rows, counts = target.density.at_rows(), []
    rows.on_progress = counts.append
    x = np.random.default_rng(3).normal(0.0, 0.3, (10, 2))
    return rows(x, np.arange(10), np.arange(10, 20))[:2], counts


def test_many_points_are_those_of_one_rank():
    (together, counts), *_ = on_ranks(2, lambda ranks: led(ranks, evaluate_rows, ranks))
    alone, _ = evaluate_rows()
    np.testing.assert_array_equal(together, alone)
    assert counts == [1] * 10


@pytest.mark.parametrize("rank", [0, 1, 2])
@pytest.mark.parametrize("evaluate", [evaluate_ten, evaluate_rows])
def test_an_error_in_an_evaluation_ends_all(evaluate, rank, monkeypatch):
    """Of a follower's the leader learns as MPI lets it: here by the barrier, else by the abort."""
    fail_on(rank, monkeypatch)
    # The followers, in the midst of the evaluation, do not answer.
    monkeypatch.setattr(leader_follower, "_ANSWER_SECONDS", 0.2)
    with pytest.raises(Unlucky, match=f"on rank {rank}"):
        on_ranks(3, lambda ranks: led(ranks, evaluate, ranks))


def outcomes(size, lead, *arguments):
    """What became of every rank: its result, or the error that it raised."""

    def call(ranks):
        try:
            return led(ranks, lead, ranks, *arguments)
        except Exception as error:
            return error

    return on_ranks(size, call)


@pytest.mark.filterwarnings("ignore:Numba will use object mode")
def test_followers_hear_of_the_leaders_error():
    @wrap_py(itypes=[dscalar], otypes=[dscalar])
    def moody(a):
        raise ValueError("not today")

    with pm.Model() as model:
        a = pm.Normal("a")
        pm.Potential("moody", moody(a))
        psf.StateSpace("d", PAIR, ENSEMBLE, steps=STEPS, observed=PAIR_DATA)

    leader, *followers = outcomes(3, lambda ranks: density_of(model, ranks))
    assert "not today" in str(leader)
    for error in followers:
        assert isinstance(error, ParallelError)
        assert "the leader of the chain has stopped" in str(error)
        assert "not today" in str(error)


def test_a_follower_that_cannot_is_named_and_not_waited_for(monkeypatch):
    """All raise in time: the follower what it met, the leader who it was."""
    distributed_evaluator = leader_follower.distributed_evaluator

    def unable(system, filter, ranks):
        if ranks.rank == 1 and filter == PARTICLES:
            raise Unlucky("no compiler")
        return distributed_evaluator(system, filter, ranks)

    monkeypatch.setattr(leader_follower, "distributed_evaluator", unable)
    leader, first, second = outcomes(3, evaluate_ten)
    assert isinstance(leader, ParallelError)
    assert "rank 1 of the 3" in str(leader)
    assert "no compiler" in str(leader)
    assert isinstance(first, Unlucky)
    assert isinstance(second, ParallelError)


def test_a_wrong_record_is_the_leaders_matter_and_can_be_mended():
    with pm.Model() as model:
        steps = pm.Data("steps", STEPS)
        pm.Normal("a")
        psf.StateSpace("d", PAIR, ENSEMBLE, steps=steps, observed=PAIR_DATA)

    def evaluate(ranks):
        good = density_of(model, ranks)
        with model:
            pm.set_data({"steps": STEPS[::-1].copy()})
        with pytest.raises(ModelError, match="increase strictly"):
            density_of(model, ranks)
        return good(np.zeros(1), (), ())

    result, _ = on_ranks(2, lambda ranks: led(ranks, evaluate, ranks))
    with model:
        pm.set_data({"steps": STEPS})
    assert result == density_of(model)(np.zeros(1), (), ())


@pytest.mark.parametrize(
    ("model", "settings", "message"),
    [
        (
            MODEL,
            {"correlation": 0.9, "stages": 1},
            r"per_chain of comm must be 1 with correlation=0.9, got 4",
        ),
        (
            two_records(psf.EKF(), psf.EKF()),
            {},
            r"per_chain of comm must be 1 for a model without .* particles, got 4",
        ),
        (MODEL, {}, r"EnKF.* 3 of 4 ranks"),
        (two_records(psf.EKF(), psf.PFEnKF(200)), {}, r"PFEnKF.* 3 of 4 ranks"),
    ],
    ids=["correlation", "no noise", "first has few", "second has few"],
)
def test_what_cannot_be_shared_is_said_before_anything_is_sent(model, settings, message):
    class Four:
        rank, size = 0, 4

    with pytest.raises(ModelError, match=message):
        Target(model, None, RandomWalkSettings(**settings), group=Four())
