"""``run_models`` in one process: each model's draws are its own, whatever the other models."""

import gc
import re
import tracemalloc
import weakref
from dataclasses import fields
from functools import partial
from inspect import signature

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from pytensor.compile.ops import wrap_py

import pymc_statespace_filters as psf
from pymc_statespace_filters import several_models
from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint.record_file import RecordFile, header_of
from pymc_statespace_filters.sampling.output.facts import EndedDram
from pymc_statespace_filters.sampling.run import model_result
from pymc_statespace_filters.sampling.run.model_task import ModelTask
from pymc_statespace_filters.sampling.run.request import RunArguments, SamplingRequest
from pymc_statespace_filters.sampling.run.thread_pool import ChainPool
from pymc_statespace_filters.sampling.target import target
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from tests.interrupts import interrupt, interrupt_chains
from tests.sampling.test_sample_dram import LOGGER, assert_identical, sample_dram, state_space_model

SETTINGS = {"draws": 50, "tune": 50, "chains": 2, "random_seed": 1, "progressbar": False}


run_chains = partial(psf.run_models, sampler="dram")


def request():
    return SamplingRequest(50, 50, 2, [1], True, None, False, None, RandomWalkSettings())


def normal_model(sd=1.0):
    with pm.Model() as model:
        pm.Normal("y", pm.Normal("mu", sigma=sd), 1.0, observed=[1.0, 2.0])
    return model


@pytest.fixture(scope="module")
def models():
    return {"cheap one": normal_model(), "dear/one": state_space_model(psf.BootstrapPF(500))}


def test_each_model_as_if_alone(models):
    trees = run_chains(models, **SETTINGS)
    assert list(trees) == list(models)
    for name, model in models.items():
        assert_identical(trees[name], sample_dram(model, **SETTINGS))


@pytest.mark.parametrize("sampler", ["auto", "smc"])
def test_no_model_is_sampled_before_all_can_be(sampler, monkeypatch):
    """The draws of the first would be lost by the error of the second."""
    with pm.Model() as regimes:
        pm.Normal("y", pm.Bernoulli("z", 0.5), 1.0, observed=[1.0, 2.0])
    monkeypatch.setattr(several_models, "_one_by_one", pytest.fail)
    with pytest.raises(ModelError, match=r"got discrete \['z'\]") as raised:
        psf.run_models({"easy": normal_model(), "regimes": regimes}, sampler=sampler)
    assert raised.value.__notes__ == ["in model 'regimes'"]


def test_the_dearest_chains_begin(models, monkeypatch):
    order, start = [], ChainPool.start
    monkeypatch.setattr(
        ChainPool, "start", lambda pool, *of: (order.append(of[0]), start(pool, *of))[1]
    )
    run_chains(models, **SETTINGS)
    assert list(dict.fromkeys(order)) == [2, 3, 0, 1]  # each again after a part of its warm-up


def test_a_cost_is_measured_on_arrays_that_live(models):
    """With what they read gone, these evaluations called whatever address came in its place."""
    task = ModelTask(models["dear/one"], request())
    bind, seen = task.prepare().density.bind, []

    def watched():
        bound = bind()
        seen.append(weakref.ref(bound))
        return bound

    task.prepare().density.bind = watched
    alive = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(target, "evaluate", lambda density: alive.append(seen[-1]() is not None))
        assert task.cost() > 0.0
    assert alive == [True] * 3


def test_threads_are_shared_by_all_models(models, monkeypatch):
    at_once, finished = [], ChainPool.finished
    monkeypatch.setattr(
        ChainPool,
        "finished",
        lambda pool, *of: (at_once.append(len(pool.running)), finished(pool, *of))[1],
    )
    run_chains(models, cores=3, **SETTINGS)
    assert max(at_once) >= 3  # with those that wait for a thread to go on


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupted_study_goes_on(models, tmp_path, monkeypatch):
    settings = SETTINGS | {"tune": 400}  # long enough for a search by the expensive filter
    expected = run_chains(models, **settings)
    settings |= {"checkpoint": tmp_path, "cores": 2}

    with monkeypatch.context() as patch:
        interrupt_chains(patch)
        with pytest.raises(KeyboardInterrupt, match="before there was a draw"):  # in the warm-up
            run_chains(models, **settings)
    files = [RecordFile(path, header_of(path)) for path in tmp_path.glob("*/run.checkpoint")]
    stored = [[key for key in ("starts", "chain 0", "chain 1") if file.read(key)] for file in files]
    assert sorted(map(len, stored)) == [1, 3]  # one had not begun
    trees = run_chains(models, **settings)
    for name in models:
        assert_identical(trees[name], expected[name])
    with pytest.raises(DataMismatchError, match="draws: "):
        run_chains(models, **settings | {"draws": 60})


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_keeps_the_model_that_has_draws(models, monkeypatch, caplog):
    """With one thread, the chains of the dear one have all ended before the others begin."""
    start, begun = ChainPool.start, []

    def interrupted(pool, number, task):
        begun.append(number)
        if len(begun) > 2:  # of the cheap one
            interrupt()
        else:
            start(pool, number, task)

    settings = SETTINGS | {"tune": 0, "cores": 1}
    expected = run_chains({"dear/one": models["dear/one"]}, **settings)
    with monkeypatch.context() as patch:
        patch.setattr(ChainPool, "start", interrupted)
        trees = run_chains(models, **settings)
    assert list(trees) == ["dear/one"]
    assert trees["dear/one"].sizes == expected["dear/one"].sizes
    (said,) = [r.message for r in caplog.records if "interrupted" in r.message]
    assert said == (
        "The run was interrupted before model 'cheap one' had a draw: the results lack this model."
    )


def test_messages_name_the_model(caplog):
    models = {"first": normal_model(), "second": normal_model(3.0)}
    run_chains(
        models, **SETTINGS | {"tune": 0}, kernel={"proposal_cov": [[1e12]]}
    )  # they stand still
    named = [re.match(r"Model '(\w+)': ", record.message) for record in caplog.records]
    assert {match.group(1) for match in named if match} == set(models)
    assert all(named)


def test_its_arguments_are_those_of_sample_dram():
    given = signature(psf.sample_dram).parameters
    for field in fields(RunArguments):
        assert given[field.name].default == field.default
    assert given.keys() - {f.name for f in fields(RunArguments)} == {
        "model",
        "pilot",
        "checkpoint",
        "comm",
    }
    for name in ("drwas", "model"):
        with pytest.raises(
            TypeError, match=rf"run_models\(\) got an unexpected keyword argument '{name}'"
        ):
            psf.run_models({"a": normal_model()}, **{name: 1})


def breaking(mu):
    if mu > 3.0:
        raise ArithmeticError("no more")
    return np.asarray(mu * 0.0)


def test_a_result_takes_little_more_than_twice_its_memory(monkeypatch):
    """On the way from chains to the tree: the chains also have counts that are not in it."""
    with pm.Model() as model:
        for name in "abcde":
            pm.Normal(name)
    highest = []

    def before_the_checks(**facts):
        highest.append(tracemalloc.get_traced_memory()[1])
        return EndedDram(**facts)

    settings = SETTINGS | {"draws": 40_000, "chains": 4}
    psf.sample_dram(model=model, **SETTINGS)
    monkeypatch.setattr(model_result, "EndedDram", before_the_checks)
    thresholds = gc.get_threshold()
    gc.set_threshold(700, 10, 10)  # a user's, not those of the tests
    tracemalloc.start()
    try:
        tree = psf.sample_dram(model=model, **settings)
    finally:
        tracemalloc.stop()
        gc.set_threshold(*thresholds)
    stored = sum(
        values.nbytes
        for group in ("posterior", "sample_stats")
        for values in tree[group].data_vars.values()
    )
    assert highest[0] < 2.25 * stored


@pytest.mark.filterwarnings("ignore:Numba will use object mode")
def test_an_error_names_chain_and_model(models):
    with pm.Model() as broken:
        pm.Potential("p", wrap_py([pt.dscalar], [pt.dscalar])(breaking)(pm.Normal("mu", 0, 3)))
    with pytest.raises(ArithmeticError) as caught:
        run_chains(models | {"broken": broken}, **SETTINGS | {"draws": 10**5}, initvals={})
    assert re.fullmatch(
        r"in chain \d of model 'broken', after \d+ iterations", caught.value.__notes__[-1]
    )


def test_particles_of_each_model_as_if_alone(models):
    """By `sample_smc`, with the evidences where `compare_evidence` finds them."""
    rivals = {"narrow": normal_model(), "wide": normal_model(5.0)}
    settings = {"draws": 40, "populations": 3, "progressbar": False}
    rng = np.random.default_rng(3)
    trees = psf.run_models(rivals, sampler="smc", random_seed=rng, **settings)
    for name, model in rivals.items():
        alone = psf.sample_smc(model=model, random_seed=np.random.default_rng(3), **settings)
        assert trees[name]["posterior"].to_dataset().equals(alone["posterior"].to_dataset())
    table = psf.compare_evidence(trees)
    assert set(table.index) == set(rivals)
    assert table.loc["wide", "log_evidence"] == trees["wide"].attrs["log_evidence"]


def test_an_error_of_one_model_keeps_the_draws_of_the_others(caplog):
    with pm.Model() as impossible:
        pm.Potential("nowhere", -np.inf + 0 * pm.Normal("x"))
    rivals = {"first": normal_model(), "impossible": impossible, "last": normal_model(5.0)}
    settings = {"draws": 40, "populations": 3, "random_seed": 1, "progressbar": False}
    trees = psf.run_models(rivals, sampler="smc", **settings)
    alone = psf.sample_smc(model=rivals["last"], **settings)
    assert list(trees) == ["first", "last"]
    assert trees["last"]["posterior"].to_dataset().equals(alone["posterior"].to_dataset())
    (said,) = [r.message for r in caplog.records if "lack it" in r.message]
    assert re.match(r"Model 'impossible' ended in an error; .* ModelError: the likelihood", said)


def test_samplers_and_arguments_of_sample(caplog):
    """Of each model as if alone, with its name in all that is said."""
    rivals = {"narrow": normal_model(), "wide": normal_model(5.0)}
    settings = {"draws": 30, "tune": 60, "chains": 2, "random_seed": 1}
    caplog.set_level("INFO")
    for sampler in ("auto", "nuts"):
        caplog.clear()
        trees = psf.run_models(rivals, sampler=sampler, until_ess=50, max_draws=240, **settings)
        said = [record.message for record in caplog.records if record.name == LOGGER]
        assert {re.match(r"Model '(\w+)': ", text)[1] for text in said} == set(rivals)
        assert {tree.attrs["sampler"] for tree in trees.values()} == {
            sampler.replace("auto", "dram")
        }
        if sampler == "auto":
            assert_identical(
                psf.run_models(rivals, until_ess=50, max_draws=240, **settings)["wide"],
                trees["wide"],
            )
            alone = psf.sample(until_ess=50, max_draws=240, model=rivals["wide"], **settings)
            assert_identical(trees["wide"], alone)
    of_sample = signature(psf.sample).parameters.keys()
    assert (
        of_sample - {"model", "sampler", "continue_from", "checkpoint", "comm"}
        == (several_models._SAMPLERS["auto"][1])
    )
    with pytest.raises(TypeError, match=r"argument 'thin': .* those of sample, without model"):
        psf.run_models(rivals, sampler="auto", thin=2)


def test_chains_of_all_models_share_ranks_where_only_the_walk_can_run(
    models, tmp_path, monkeypatch
):
    """The draws are those of `sample`, which takes the walk for each."""
    calls, sampled = [], several_models.sample_models

    def together(models, *arguments):
        calls.append(list(models))
        return sampled(models, *arguments)

    monkeypatch.setattr(several_models, "sample_models", together)
    settings = {"draws": 100, "tune": 100, "random_seed": 3, "progressbar": False}
    trees = psf.run_models(models, checkpoint=tmp_path / "all", **settings)
    assert calls == [list(models)]
    for name, model in models.items():
        alone = psf.sample(model=model, checkpoint=tmp_path / name, **settings)
        xr.testing.assert_equal(trees[name]["posterior"], alone["posterior"])
        assert trees[name].attrs["sampler_reason"] == alone.attrs["sampler_reason"]


def test_what_particles_do_not_take_is_refused():
    rivals, impossible = {"one": normal_model()}, pm.Model()
    with pytest.raises(ModelError, match=r"sampler must be one of .* got 'nutz'"):
        psf.run_models(rivals, sampler="nutz")
    with pytest.raises(TypeError, match=r"argument 'tune': .* those of sample_smc"):
        psf.run_models(rivals, sampler="smc", tune=10)
    with pytest.raises(ModelError, match="pilot must be None with sampler='smc'"):
        psf.run_models(rivals, sampler="smc", pilot={})
    with impossible:
        pm.Uniform("y", pm.Normal("m"), 100.0, observed=-100.0)
    with pytest.raises(ModelError, match="likelihood is positive at 0 of") as caught:
        psf.run_models({"impossible": impossible}, sampler="smc", draws=10)
    assert caught.value.__notes__ == ["in model 'impossible'"]
