"""The paragraph that ``sample_dram`` logs at its end."""

import logging
import re
from functools import partial

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.run import model_task
from tests.kernels import with_kernel
from tests.sampling.test_dram import nan_beyond, simple_model
from tests.sampling.test_sample_dram import LOGGER, sample_dram, state_space_model


@pytest.fixture
def report_of(caplog):
    """The report of a run, and all that it logged."""

    def run(model, **settings):
        caplog.clear()
        with caplog.at_level(logging.DEBUG, logger=LOGGER):
            tree = sample_dram(model, **with_kernel(settings))
        records = [r for r in caplog.records if re.match(r"\d+ chains? of", r.message)]
        assert len(records) == 1
        assert records[0] is caplog.records[-1]  # after the warnings
        return records[0], tree, list(caplog.messages)

    return run


def two_modes(gap, width=1.0, prior=pm.Flat):
    """Modes at 0 and at 1000, the second so wide and so many nats lower."""
    with pm.Model() as model:
        x = prior("x")
        second = -gap - 0.5 * ((x - 1000.0) / width) ** 2
        pm.Potential("modes", pt.switch(x < 500.0, -0.5 * x**2, second))
    return model


IN_BOTH = {"tune": 0, "proposal_cov": [[4.0]], "initvals": [{"x": 0.0}, {"x": 1000.0}]}


def test_a_good_run(report_of):
    import arviz as az

    record, tree, messages = report_of(simple_model(), draws=4000, tune=1000, chains=4)
    text = record.message
    assert text.startswith("4 chains of 4000 draws after a warm-up of 1000; ")
    ess = az.ess(tree["posterior"].to_dataset())
    least = min(ess.data_vars, key=lambda name: float(ess[name]))
    assert f"smallest bulk effective sample size is {float(ess[least]):.0f} ({least})" in text
    # On the unconstrained space, where that of sigma differs a little.
    largest = max(float(value) for value in az.rhat(tree["posterior"].to_dataset()).values())
    assert float(re.search(r"largest R-hat ([\d.]+) \(", text)[1]) == pytest.approx(
        largest, abs=0.003
    )
    rates = tree["sample_stats"]["accepted"].mean("draw")
    assert f"in {100 * rates.min():.0f} to {100 * rates.max():.0f} % of their iter" in text
    assert "None of 16000 evaluations after the warm-up failed." in text
    assert text.endswith(" No problems found.")
    assert "nats" not in text
    assert messages == [text]


def test_too_few_draws(report_of):
    record, _, messages = report_of(simple_model(), draws=100)
    assert "No problems" not in record.message
    (said,) = messages[:-1]
    assert re.match(
        "The (chains have not mixed|draws are worth too little): the smallest bulk", said
    )
    assert re.search(r"About \d+ iterations of each .* would do, in .*until_ess=200 does it", said)
    record, *_ = report_of(simple_model(), draws=2)
    assert "R-hat" not in record.message
    record, *_ = report_of(simple_model(), draws=200, compute_convergence_checks=False)
    assert "R-hat" not in record.message


@pytest.mark.parametrize(("progressbar", "level"), [(False, "DEBUG"), (True, "INFO")])
def test_it_is_for_those_who_watch(report_of, progressbar, level, capfd):
    record, *_ = report_of(simple_model(), progressbar=progressbar)
    assert (record.name, record.levelname) == (LOGGER, level)
    assert "chains of" not in capfd.readouterr().out


@pytest.mark.parametrize("adaptation", ["chain", "continuous"])
def test_a_chain_in_a_lower_mode_is_named(report_of, adaptation):
    record, _, messages = report_of(two_modes(1290.0), draws=500, adaptation=adaptation, **IN_BOTH)
    (warning,) = [text for text in messages if text is not record.message]
    assert warning.startswith("Chain 1 stayed 1290 nats below chain 0 (median log-density): it")
    assert "find_starts" in warning


def test_chains_share_a_warm_up_which_leads_out_of_a_lower_mode(report_of):
    """Continuous adaptation alone leaves it 1290 nats below."""
    settings = IN_BOTH | {"tune": 300, "adaptation": "continuous"}
    _, tree, messages = report_of(two_modes(1290.0), draws=500, **settings)
    assert "nats below" not in "".join(messages)
    assert float(tree["sample_stats"]["lp"].median("draw").min()) > -5.0


def test_modes_of_one_height_are_no_shortfall(report_of):
    model = two_modes(5.0, prior=partial(pm.Normal, sigma=1e4))
    _, _, messages = report_of(model, draws=500, **IN_BOTH)
    assert "nats" not in "".join(messages)
    (said,) = messages[:-1]
    assert re.search(r"R-hat .*stays above 1.01, draw all modes .*psf.sample_smc\(", said)
    assert "noise" not in said
    assert "particles" not in said


def test_an_improper_prior_is_named_and_no_number_of_iterations(report_of):
    """Whose modes `sample_smc` cannot draw."""
    _, _, messages = report_of(two_modes(5.0), draws=500, **IN_BOTH)
    (said,) = messages[:-1]
    assert said.endswith(
        "The prior of x is improper: what the data leave undetermined spreads without end, however "
        "many iterations there are; give a proper prior."
    )


@pytest.mark.parametrize("width", [1e5, np.inf])
def test_proposals_that_grow_are_the_one_cause_unless_chains_agree(report_of, width):
    with pm.Model() as model:
        pm.Potential("likelihood", -0.5 * (pm.Flat("x") / width) ** 2)
    record, _, messages = report_of(model, draws=4000, tune=1000, chains=4)
    if np.isfinite(width):
        assert record.message.endswith(" No problems found.")
    else:
        (said,) = messages[:-1]
        assert "The proposals of x have become" in said


def test_a_stuck_chain_is_named(report_of):
    _, _, messages = report_of(two_modes(0.0, width=1e-6), draws=500, **IN_BOTH)
    (said,) = messages[:-1]  # R-hat has the same cause
    assert "Chain 1: DRAM accepted 0 of 500 proposals" in said
    assert "proposal_cov" in said


def test_a_chain_may_be_stuck_and_another_low(report_of):
    _, _, messages = report_of(two_modes(-50.0, width=1e-6), draws=500, **IN_BOTH)
    stuck, low = sorted(messages[:-1], reverse=True)
    assert stuck.startswith("Chain 1: DRAM accepted 0 of 500 proposals")
    assert low.startswith("Chain 0 stayed 50 nats below chain 1")


def test_chains_with_one_cause_share_a_message(report_of):
    """All three chains that stand still, and those that are low."""
    starts = [{"x": 0.0}, {"x": 1000.0}, {"x": 1000.0 + 1e-7}]
    call = IN_BOTH | {"initvals": starts, "chains": 3, "draws": 500}
    _, _, messages = report_of(two_modes(0.0, width=1e-6), **call)
    (said,) = messages[:-1]
    assert said.startswith("Chains 1 and 2: DRAM accepted 0 of 500 proposals")
    _, _, messages = report_of(two_modes(300.0), **call)
    (said,) = messages[:-1]
    assert said.startswith("Chains 1 and 2 stayed 300 to 300 nats below chain 0 (median")


def test_failures_are_counted_with_their_reason(report_of):
    record, tree, _ = report_of(nan_beyond(0.0), draws=500)
    stats = tree["sample_stats"]
    failed, made = int(stats["n_failed"].sum()), int(stats["n_evaluations"].sum())
    assert failed
    assert (
        f"{failed} of {made} evaluations after the warm-up ({100 * failed / made:.0f} %) failed "
        f"and were rejected: the log-density is NaN or plus infinity ({failed})."
    ) in record.message


def test_elements_of_vectors_are_named(report_of):
    with pm.Model() as model:
        pm.Normal("theta", sigma=np.array([1.0, 1.0]), shape=2)
        pm.HalfNormal("scale")
    record, *_ = report_of(model)
    assert re.search(r"is \d+ \((theta\[[01]\]|scale)\)", record.message)


def test_models_are_named(caplog):
    with caplog.at_level(logging.DEBUG, logger=LOGGER):
        psf.run_models(
            {"one": simple_model()}, sampler="dram", draws=50, tune=50, chains=2, progressbar=False
        )
    assert any(text.startswith("Model 'one': 2 chains of 50 draws") for text in caplog.messages)


def test_chains_below_what_the_search_has_met_never_reached_the_posterior(report_of, monkeypatch):
    """Told once, whatever else follows from it; not of estimates, which may be far too high."""
    find_population = model_task.ModelTask.find_population

    def higher(task, **settings):
        found = find_population(task, **settings)
        return found._replace(level=found.level + 100.0)

    monkeypatch.setattr(model_task.ModelTask, "find_population", higher)
    _, _, messages = report_of(simple_model(), draws=50, tune=400)
    (said,) = messages[:-1]
    assert re.match(r"The chains never reached the posterior: .* stayed 10\d nats", said)
    _, _, messages = report_of(state_space_model(psf.BootstrapPF(200)), draws=50, tune=400)
    assert "never reached" not in "".join(messages)


def test_a_few_high_points_do_not_tell_that_the_chains_never_reached_the_posterior(report_of):
    """In the neck of a funnel the density has no bound, and there is hardly any mass."""
    with pm.Model() as schools:
        tau = pm.HalfCauchy("tau", 5)
        theta = pm.Normal("theta", pm.Normal("mu", 0, 5), tau, shape=8)
        errors = [15, 10, 16, 11, 9, 11, 10, 18]
        pm.Normal("y", theta, errors, observed=[28, 8, -3, 7, -1, 1, 18, 12])
    _, _, messages = report_of(schools, draws=300, tune=1000)
    assert "never reached" not in "".join(messages)
