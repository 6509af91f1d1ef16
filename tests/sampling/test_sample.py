"""The front door: thinning, the choice of the sampler, refusals, and what NUTS returns."""

from dataclasses import fields

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters import sample
from pymc_statespace_filters.sampling import choice
from pymc_statespace_filters.sampling.kernel.state import N_ACCEPTED, N_COUNTS, Draws
from pymc_statespace_filters.sampling.output.convergence import convergence
from pymc_statespace_filters.sampling.output.phase_statistics import PhaseStatistics
from pymc_statespace_filters.sampling.run.thinned_draws import Thinning, add_iterations, coarsen
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from tests.kernels import with_kernel
from tests.sampling.test_dram import simple_model
from tests.sampling.test_sample_dram import state_space_model

QUIET = {"random_seed": 1, "progressbar": False}


def made_up_draws(n, rng):
    return Draws(
        rng.normal(size=(n, 2)),
        rng.normal(size=(n, 4)),
        rng.integers(3, size=(n, 8)),
        rng.integers(9, size=(n, 1)),
        np.empty((0, 2, 2)),
    )


def kept(iterations, rule, cuts):
    """Iterations added in parts, with the rows of a rule."""
    n = len(iterations.positions)
    draws = Draws(*(np.zeros((n, *a.shape[1:]), a.dtype) for a in iterations[:-1]), iterations.covs)
    for begin, end in zip([0, *cuts], [*cuts, n], strict=True):
        part = Draws(*(a[begin:end] for a in iterations[:-1]), iterations.covs)
        add_iterations(draws, rule.rows(np.arange(begin, end)), part)
    return Draws(*(a[: -(-(n - rule.n_all) // rule.every) + rule.n_all] for a in draws))


def test_a_row_is_the_same_however_its_iterations_came_into_it():
    rng = np.random.default_rng(2)
    iterations, rule = made_up_draws(41, rng), Thinning(5, 4)
    whole = kept(iterations, rule, [])
    for cuts in ([1, 7, 8, 30], [17], list(range(1, 41))):
        for mine, theirs in zip(kept(iterations, rule, cuts), whole, strict=True):
            np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(whole.positions[5:14], iterations.positions[8:41:4])
    sums = iterations.counts[5:].reshape(9, 4, 8).sum(axis=1)
    np.testing.assert_array_equal(whole.counts[5:, [1, 2, 4, 5, 6, 7]], sums[:, [1, 2, 4, 5, 6, 7]])
    fine = kept(iterations, rule._replace(every=2), [])
    coarsen(fine, rule._replace(every=2).n_rows(41), rule._replace(every=2), rule)
    for mine, theirs in zip(fine, whole, strict=True):
        np.testing.assert_array_equal(mine[: len(theirs)], theirs)


@pytest.fixture(scope="module")
def every_iteration():
    return psf.sample_dram(204, tune=100, model=simple_model(), chains=2, **QUIET)


def test_a_draw_is_the_last_of_k_iterations(every_iteration):
    """Whether k was given, or found by doubling; an odd number of draws leaves half a row."""
    draws = 51
    call = {"model": simple_model(), "chains": 2, "tune": 100, **QUIET}
    thinned = psf.sample_dram(draws, thin=4, **call)
    doubled = sample(draws, sampler="dram", until_ess=2 * draws, max_draws=4 * draws + 1, **call)
    whole = every_iteration["sample_stats"].isel(draw=slice(0, 4 * draws))
    for name, values in every_iteration["posterior"].data_vars.items():
        np.testing.assert_array_equal(thinned["posterior"][name], values[:, 3 : 4 * draws : 4])
    for tree in (thinned, doubled):
        assert tree.attrs["iterations_per_draw"] == 4
        stats = tree["sample_stats"]
        assert stats["n_evaluations"].sum() == whole["n_evaluations"].sum()
        np.testing.assert_allclose(stats["accepted"].mean(), whole["accepted"].mean())
    xr.testing.assert_identical(
        thinned["sample_stats"].to_dataset().drop_attrs(),
        doubled["sample_stats"].to_dataset().drop_attrs(),
    )
    xr.testing.assert_equal(thinned["posterior"].to_dataset(), doubled["posterior"].to_dataset())


def test_records_are_thinned_too():
    from tests.sampling.test_record_chains import panel_model

    model = panel_model(psf.EKF())
    call = {"model": model, "chains": 1, "tune": 20, **QUIET}
    whole, thinned = psf.sample_dram(30, **call), psf.sample_dram(10, thin=3, **call)
    for name, values in whole["posterior"].data_vars.items():
        np.testing.assert_array_equal(thinned["posterior"][name], values[:, 2::3])
    rates = [tree["sample_stats"]["record_accepted"].mean("draw") for tree in (whole, thinned)]
    np.testing.assert_allclose(*rates)


@pytest.mark.parametrize("n_parts", [10, 14])
def test_a_doubled_run_resumes_with_the_same_bits(tmp_path, monkeypatch, n_parts):
    """Killed before and after k was doubled."""
    from pymc_statespace_filters.sampling.run import chain_task

    call = {"model": simple_model(), "chains": 2, "tune": 40, "cores": 1, **QUIET}
    call |= {"draws": 25, "sampler": "dram", "until_ess": 50, "max_draws": 200}
    expected = sample(**call)
    monkeypatch.setattr(chain_task, "CHECKPOINT_SECONDS", 0.0)
    made = []

    def die(self, *args, _advance=chain_task.ChainTask._advance):
        made.append(0)
        if len(made) > n_parts:
            raise MemoryError
        _advance(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(chain_task.ChainTask, "_advance", die)
        with pytest.raises(MemoryError):
            sample(**call, checkpoint=tmp_path)
    for _ in range(2):
        found = sample(**call, checkpoint=tmp_path)
        for group in ("posterior", "sample_stats"):
            xr.testing.assert_equal(found[group].to_dataset(), expected[group].to_dataset())
        assert found.attrs["iterations_per_draw"] == 8


def test_a_run_ends_as_soon_as_its_draws_are_worth_enough():
    """At the first power of two: chains with this k, and with half of it, show it."""
    call = {"model": simple_model(), "tune": 200, **QUIET}
    tree = sample(150, until_ess=350, **call)
    k = tree.attrs["iterations_per_draw"]
    assert 2 <= k <= 32

    def found(thin):
        draws = psf.sample_dram(150, thin=thin, **call)["posterior"]
        values = [draws["mu"].values, np.log(draws["sigma"].values)]
        return convergence([np.stack(of, axis=1) for of in zip(*values, strict=True)])

    assert found(k).reaches(350)
    assert not found(k // 2).reaches(350)


def test_the_end_of_a_run_that_reached_nothing(caplog):
    """By its iterations, and by its time, with what would do."""
    call = {"model": simple_model(), "tune": 100, **QUIET}
    sample(50, sampler="dram", until_ess=100, max_draws=100, **call)
    assert "was not reached with 100 iterations" in caplog.text
    assert "iterations of each chain would do" in caplog.text
    assert "larger max_draws than 100" in caplog.text


@pytest.mark.parametrize(
    ("draws", "chains", "said"),
    [(100, 1, "Give more draws"), (50, 4, "Give more draws"), (1, 1, "")],
)
def test_few_draws_are_asked_for_what_they_can_show(draws, chains, said, caplog):
    tree = sample(draws, 100, sampler="dram", model=simple_model(), chains=chains, **QUIET)
    assert tree.attrs["iterations_per_draw"] <= 64
    assert said in caplog.text
    assert "hardly moves" not in caplog.text
    assert "stayed at one point" not in caplog.text


@pytest.mark.parametrize("most", [3, 8])
def test_draws_follow_max_draws(most):
    """Fewer than chains, and so few that a run of NUTS that is beaten has none."""
    tree = sample(max_draws=most, tune=20, model=simple_model(), **QUIET)
    assert tree["posterior"].sizes["draw"] == most
    assert tree.attrs["iterations_per_draw"] == 1


def test_more_than_the_draws_show(caplog):
    """Half of them and more is allowed, and the advice is the only one that works."""
    call = {"until_ess": 59, "max_draws": 30, "sampler": "dram"}
    sample(30, 100, model=simple_model(), chains=2, **call, **QUIET)
    assert "Give more draws: 2 * 30 hardly show so many" in caplog.text
    assert "would do" not in caplog.text


def test_a_row_that_moved_may_have_moved_at_its_end():
    counts = np.zeros((5, N_COUNTS), int)
    counts[[1, 4], N_ACCEPTED] = 1
    numbers = np.ones((5, 4))
    draws = made_up_draws(5, np.random.default_rng(1))._replace(counts=counts, numbers=numbers)
    assert PhaseStatistics.from_draws(draws, 0, 5).longest_dwell == 3
    assert PhaseStatistics.from_draws(draws, 0, 5, thin=8).longest_dwell == 2 * 8 + 1
    assert PhaseStatistics.from_draws(draws, 1, 2, thin=1024).longest_dwell == 1


def linear_model(n, filter=None, *, kink=False):
    """An autoregression with n parameters, one of them of its equations."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [(abs(a) if kink else a) * x[0] + q[0]],
        process_noise=[[0.1]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
    )
    rng = np.random.default_rng(1)
    with pm.Model() as model:
        b = pm.Normal("b", 0, 1, shape=n - 1)
        pm.Potential("c", -0.5 * ((b[1:] - b[:-1]) ** 2).sum())
        pm.Normal("a", 0, 0.5)
        psf.StateSpace(
            "d", system, filter or psf.EKF(), steps=np.arange(30), observed=rng.normal(size=30)
        )
    return model


def test_the_choice():
    assert choice.why_no_nuts(linear_model(3)) == ""
    assert "noise" in choice.why_no_nuts(linear_model(3, psf.BootstrapPF(10)))
    assert "no gradient" in choice.why_no_nuts(linear_model(3, psf.GridFilter()))
    assert sample(5, 0, model=linear_model(3), **QUIET).attrs["sampler"] == "dram"
    assert choice.why_dram(linear_model(3)) == ""
    with pm.Model() as undetermined:
        pm.Flat("a")
    assert choice.why_no_nuts(undetermined) == (
        "the density has no gradient with respect to some parameter"
    )
    kinked = choice.why_dram(linear_model(200, kink=True))
    assert kinked == "the equations of 'd' have kinks or jumps"


@pytest.fixture(scope="module", params=["noise", "records", "records_by_given_cov"])
def two_parts(request, tmp_path_factory):
    """A run in one piece, and in two with a file between them.

    Records have centred coordinates, but those of the model if the covariance is given.
    """
    from tests.sampling.test_record_chains import panel_model

    if request.param == "noise":
        model = state_space_model(psf.BootstrapPF(20))
    else:
        model = panel_model(psf.EKF(), centred=False)
    call = {"model": model, "chains": 2, "progressbar": False}
    cov = 0.1 * np.eye(4) if "given" in request.param else None
    given = {"kernel": {"proposal_cov": cov}}
    whole, first = (
        psf.sample_dram(n, 60, thin=2, random_seed=3, **call, **given) for n in (70, 30)
    )
    path = tmp_path_factory.mktemp("draws") / "first.nc"
    first.to_netcdf(path)
    read = xr.open_datatree(path).load()
    read.close()
    read.attrs["sampler_reason"] = "as the race found"
    return whole, sample(40, continue_from=read, **call), read, call


def test_chains_go_on_with_the_bits_of_one_run(two_parts):
    whole, both, _, _ = two_parts
    for group in ("posterior", "sample_stats", "sampler_state"):
        xr.testing.assert_equal(both[group].to_dataset(), whole[group].to_dataset())
    assert both["sampler_state"].attrs == whole["sampler_state"].attrs
    assert both["posterior"].attrs["tuning_steps"] == 60
    assert both.attrs["sampler_reason"] == "as the race found"


def test_chains_that_cannot_go_on(two_parts):
    _, _, first, call = two_parts
    other = call | {"model": linear_model(3)}
    refused = [
        (other, "of this model"),
        (call | {"chains": 3}, "chains must be that of continue_from, 2, got 3"),
        (call | {"random_seed": 1}, "random_seed must be None with continue_from"),
        (call | {"kernel": {"stages": 1}}, "kernel must be as in the run"),
        (call | {"sampler": "nuts"}, "continue_from must be None with sampler='nuts'"),
    ]
    for arguments, message in refused:
        with pytest.raises((psf.errors.ModelError, psf.errors.DataMismatchError), match=message):
            sample(10, continue_from=first, **arguments)
    for part in (slice(0, 20), slice(None, None, 2)):
        with pytest.raises(psf.errors.ModelError, match="must have all draws of its run, 30 of"):
            sample(10, continue_from=first.isel(draw=part), **call)
    short = first.copy()
    del short["sampler_state"]
    with pytest.raises(psf.errors.ModelError, match="must have the group 'sampler_state'"):
        sample(10, continue_from=short, **call)
    short.attrs["sampler"] = "nuts"
    with pytest.raises(psf.errors.ModelError, match="those of NUTS, which cannot go on"):
        sample(10, continue_from=short, **call)


REFUSALS = [
    ({"sampler": "gibbs"}, r"sampler must be one of .* got 'gibbs'"),
    ({"sampler": "nuts", "kernel": {}}, r"kernel must be None .*'dram' has"),
    ({"sampler": "nuts", "checkpoint": "x"}, "checkpoint must be None with sampler='nuts'"),
    ({"sampler": "nuts", "comm": "world"}, "comm must be None with sampler='nuts'"),
    ({"sampler": "nuts", "initvals": [{}] * 4}, "initvals must be a mapping for sampler='nuts'"),
    ({"sampler": "nuts", "initvals": {"x": 1.0}}, "initvals must name free variables .* got 'x'"),
    ({"sampler": "nuts", "cores": 0}, "cores must be None or an integer of at least 1, got 0"),
    ({"sampler": "nuts", "tune": 0}, "tune must be at least 1 with sampler='nuts', got 0"),
    (
        {"draws": 100, "until_ess": 401},
        r"until_ess must be at most .* 4 \* 100, got 401: give more",
    ),
    ({"kernel": {"stage": 1}}, "kernel must be a mapping of some of stages, .*, got .'stage': 1"),
    ({"kernel": 1}, "kernel must be a mapping of some of .*, or None, got 1"),
    ({"comm": {"ranks": 2}}, "comm must be a mapping of some of comm, per_chain, gather, got"),
    ({"comm": {"per_chain": 0}}, "per_chain must be an integer of at least 1, got 0"),
    ({"until_ess": 0}, "until_ess must be"),
    ({"until_ess": None, "max_draws": 5}, "max_draws needs until_ess"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSALS)
def test_refusals(changes, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        sample(model=linear_model(3), **changes, progressbar=False)


def test_a_model_without_continuous_variables():
    with pm.Model() as empty:
        pm.Normal("y", observed=1.0)
    with pm.Model() as counts:
        pm.Poisson("n", 3)
    for model, message in ((empty, "at least one free variable"), (counts, "discrete")):
        with pytest.raises(psf.errors.ModelError, match=message):
            sample(model=model, progressbar=False)


def test_nuts_refuses_noise():
    with pytest.raises(psf.errors.ModelError, match=r"sampler must be 'dram' .* 'd0' is estimated"):
        sample(model=state_space_model(psf.BootstrapPF(10)), sampler="nuts", progressbar=False)


@pytest.mark.parametrize("function", [psf.sample_dram, psf.run_models])
def test_an_old_spelling_names_the_new_one(function):
    for field in fields(RandomWalkSettings):
        message = rf"'{field.name}': give kernel=\{{\"{field.name}\": ...\}}"
        with pytest.raises(TypeError, match=message):
            function({}, **{field.name: 1})
    with pytest.raises(TypeError, match=r"'gather': give comm=\{\"gather\": ...\}"):
        function({}, gather="all")
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'stage'"):
        function({}, stage=1)


def test_settings_are_equal_if_their_values_are():
    kernel = {"proposal_cov": np.eye(2), "stages": 1}
    first, second = (
        RandomWalkSettings.of(kernel),
        RandomWalkSettings.of(kernel | {"stages": (1, 1)}),
    )
    assert first == second
    assert hash(first) == hash(second)
    assert with_kernel(kernel) == {"kernel": kernel}


def test_a_filter_and_its_evidence_after_nuts():
    """The law of a linear model, and the same kind of result as of the walk."""
    model = state_space_model(psf.EKF())
    found = {
        name: sample(300, tune=300, model=model, sampler=name, **QUIET) for name in ("nuts", "dram")
    }
    for name, tree in found.items():
        assert tree.attrs["sampler"] == name
        assert "lp" in tree["sample_stats"]
    assert set(found["dram"].attrs) == set(found["nuts"].attrs)
    both = [tree["posterior"] for tree in found.values()]
    for name in both[0].data_vars:
        means = [of[name].mean() for of in both]
        # 240 effective draws each: four errors of the difference.
        assert abs(means[0] - means[1]) < 4 * both[1][name].std() * np.sqrt(2 / 240)
    evidence = [
        psf.estimate_evidence(tree, model, estimators=("bridge",), random_seed=1)["bridge"]
        for tree in found.values()
    ]
    difference = evidence[0].log_evidence - evidence[1].log_evidence
    assert abs(difference) < 4 * np.hypot(*(one.se for one in evidence))
    groups = [set(tree.children) for tree in (found["nuts"], found["dram"])]
    assert groups[1] - groups[0] == {"sampler_state"}
    again = sample(300, tune=300, model=model, sampler="nuts", **QUIET)
    xr.testing.assert_equal(again["posterior"].to_dataset(), both[0].to_dataset())
