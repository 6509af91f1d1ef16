"""Chains of NUTS that diverge end where more iterations do not help, and say so."""

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.nuts import chains as nuts_chains

ERRORS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])
EFFECTS = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])
CALL = {"sampler": "nuts", "random_seed": 1, "progressbar": False}


def schools(*, centred):
    with pm.Model() as model:
        mu, tau = pm.Normal("mu", 0, 5), pm.HalfCauchy("tau", 5)
        theta = (
            pm.Normal("theta", mu, tau, shape=8) if centred else mu + tau * pm.Normal("z", shape=8)
        )
        pm.Normal("y", theta, ERRORS, observed=EFFECTS)
    return model


def test_a_funnel_ends_the_run_at_the_first_doubling_that_does_not_help(caplog):
    tree = psf.sample(250, tune=500, model=schools(centred=True), **CALL)

    assert 2 <= tree.attrs["iterations_per_draw"] <= 8  # of 64
    assert "draws diverged, most where tau is small" in caplog.text
    assert "More iterations do not help draws that diverge: use sampler='dram'" in caplog.text
    assert "would do" not in caplog.text  # no number of iterations does


def test_chains_that_do_not_diverge_go_on_however_little_they_gain(monkeypatch):
    monkeypatch.setattr(nuts_chains, "_LEAST_GROWTH", 1e6)
    tree = psf.sample(100, tune=300, until_ess=395, model=schools(centred=False), **CALL)
    assert tree.attrs["iterations_per_draw"] > 2
