"""Runs that end on their way, and go on from their checkpoint with the same bits."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.coverage.missed_modes import MissedMode
from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.parameter_particles import stored_steps, whole_data
from pymc_statespace_filters.parameter_particles.observed_rows import ObservedRows
from pymc_statespace_filters.parameter_particles.stored_steps import StoredSteps
from pymc_statespace_filters.parameter_particles.whole_data import WholeLikelihood
from tests.parameter_particles.autoregression import DATA, model

SETTINGS = {"draws": 20, "populations": 2, "random_seed": 2, "progressbar": False}
KINDS = {
    "tempered": {"data": "tempered"},
    "sequential": {"data": "sequential", "inner": psf.BootstrapPF(6)},
}

pytestmark = pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles


class Ended(BaseException):
    """What ends a process."""


def found_among(populations, log_evidences, visited, evaluate, n_evaluations, rng):
    """A mode at the mean of all points on the way."""
    return MissedMode(visited.x.mean(axis=0), 0.0, rng.random(), float(len(visited.x)))


@pytest.fixture
def often(monkeypatch):
    """Every step is stored."""
    monkeypatch.setattr(stored_steps, "SECONDS", 0.0)


def ending_after(n_steps, monkeypatch):
    """Let runs end after some steps."""
    save, saved = StoredSteps.save, []

    def save_and_end(steps, arrays, **settings):
        save(steps, arrays, **settings)
        saved.append(1)
        if len(saved) == n_steps:
            raise Ended

    monkeypatch.setattr(StoredSteps, "save", save_and_end)


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_run_goes_on_where_it_ended(kind, often, tmp_path, monkeypatch):
    """It ends twice; when it is complete, another call reads it.

    The look for modes that were missed is at points of the whole way, thinned as it goes on.
    """
    monkeypatch.setattr(whole_data, "missed_mode", found_among)
    monkeypatch.setattr(whole_data, "LOOK", 10.0)
    monkeypatch.setattr(whole_data, "MOST_VISITED", 100)
    settings = {**SETTINGS, **KINDS[kind], "model": model(psf.EKF(), 9)}
    whole = psf.sample_smc(**settings)
    for _ in range(2):
        with monkeypatch.context() as patch:
            ending_after(1 if kind == "tempered" else 4, patch)
            with pytest.raises(Ended):
                psf.sample_smc(**settings, checkpoint=tmp_path)
    resumed = psf.sample_smc(**settings, checkpoint=tmp_path)
    for of in (ObservedRows, WholeLikelihood):
        monkeypatch.delattr(of, "drawn" if of is ObservedRows else "draw")
    complete = psf.sample_smc(**settings, checkpoint=tmp_path)
    if kind == "tempered":
        assert "have missed" in whole.attrs["unvisited"]
    for found in (resumed, complete):
        assert found.attrs == whole.attrs
        for name in whole.children:
            assert found[name].to_dataset().equals(whole[name].to_dataset())


def test_points_of_the_way_are_stored_only_for_a_look(often, tmp_path, monkeypatch):
    """Without those before its end a run that goes on does not look."""
    monkeypatch.setattr(whole_data, "missed_mode", found_among)
    monkeypatch.setattr(whole_data, "LOOK", 10.0)
    stored, save = [], StoredSteps.save

    def noted(steps, arrays, **settings):
        stored.append(arrays())
        save(steps, arrays, **settings)

    monkeypatch.setattr(StoredSteps, "save", noted)
    settings = {**SETTINGS, "model": model(psf.EKF(), 9), "checkpoint": tmp_path}
    with monkeypatch.context() as patch:
        ending_after(1, patch)
        with pytest.raises(Ended):
            psf.sample_smc(**settings, compute_convergence_checks=False)
    assert "unvisited" not in psf.sample_smc(**settings).attrs
    assert len(stored) > 1
    assert not [name for arrays in stored for name in arrays if name.startswith("visited")]


def test_a_run_without_a_seed_keeps_its_own(often, tmp_path):
    settings = {**SETTINGS, "model": model(psf.EKF(), 9), "random_seed": None}
    first, second = (psf.sample_smc(**settings, checkpoint=tmp_path) for _ in range(2))
    assert first["posterior"].to_dataset().equals(second["posterior"].to_dataset())


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    settings = {**SETTINGS, "model": model(psf.EKF(), 3), "checkpoint": tmp_path}
    psf.sample_smc(**settings)

    def refused(match, **changes):
        with pytest.raises(DataMismatchError, match=match):
            psf.sample_smc(**settings | changes)

    refused("draws: the checkpoint has 20, this run has 30", draws=30)
    refused('data: the checkpoint has "tempered", this run has "sequential"', data="sequential")
    refused("random_seed: .*", random_seed=3)
    other = model(psf.EKF(), 3, observed=DATA[:3] + 1e-9)
    refused("observed and other data: the checkpoint has", model=other)
    refused("; model: the checkpoint has|another run: model: ", model=model(psf.UKF(), 3))
    refused('inner: the checkpoint has "", this run has "UKF', inner=psf.UKF())
    refused('screen: the checkpoint has "", this run has "UKF', screen=psf.UKF())
    refused("populations: the checkpoint has 2, this run has 3", populations=3)
    refused("waste_free: the checkpoint has true, this run has false", waste_free=False)


def test_rivals_have_folders_of_their_own(tmp_path, often, monkeypatch):
    models = {"EKF": model(psf.EKF(), 3), "UKF": model(psf.UKF(), 3)}
    settings = {**SETTINGS, "sampler": "smc"}
    whole = psf.run_models(models, **settings)
    with monkeypatch.context() as patch:
        ending_after(2, patch)
        with pytest.raises(Ended):
            psf.run_models(models, **settings, checkpoint=tmp_path)
    resumed = psf.run_models(models, **settings, checkpoint=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    for name, tree in whole.items():
        np.testing.assert_array_equal(resumed[name]["posterior"]["a"], tree["posterior"]["a"])
