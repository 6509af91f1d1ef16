"""An evidence of chains that stayed below the posterior is not passed for that of the posterior."""

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.evidence.unreached import check_reached, log_mass_at
from tests.evidence.hard_targets import Funnel
from tests.evidence.targets import Normals, autoregressive

K = 3
PEAK, WIDTH = np.array([0.4, -0.2, 0.1]), 1e-7


def narrow(height):
    """A narrow peak on a wide normal, and where the wide one is drawn."""

    def log_density(x):
        wide = norm.logpdf(x).sum(axis=-1)
        return np.logaddexp(wide, height + norm.logpdf((x - PEAK) / WIDTH).sum(axis=-1))

    return log_density


def posterior_of(log_density, draws, is_noisy=False):
    flat = draws.reshape(-1, draws.shape[-1])
    values = log_density(flat).reshape(draws.shape[:2])
    return Posterior(
        draws, values, lambda x, rng: log_density(x), is_noisy, prior=Normals(np.ones(K))
    )


def test_the_mass_at_a_peak_of_any_width_and_correlation():
    rng = np.random.default_rng(1)
    chol = 1e-6 * np.tril(rng.standard_normal((4, 4))) + 1e-7 * np.eye(4)
    inverse = np.linalg.inv(chol)

    def log_density(x):
        return 5.0 - 0.5 * ((x @ inverse.T) ** 2).sum(axis=-1)

    truth = 5.0 + 2 * np.log(2 * np.pi) + np.linalg.slogdet(chol)[1]
    start = chol @ rng.standard_normal(4)
    assert log_mass_at(log_density, start, np.ones(4)) == pytest.approx(truth, abs=1e-3)
    assert log_mass_at(lambda x: x[:, 0], start, np.ones(4)) is None  # no mode


@pytest.mark.parametrize(("height", "reached"), [(150.0, False), (45.0, True), (20.0, True)])
def test_the_mass_of_a_higher_peak_decides(height, reached):
    """Its log-mass is the height minus 48: with 45 it is a spike of no mass."""
    draws = autoregressive((4, 500, K), 0.5, np.random.default_rng(2))
    log_density = narrow(height)
    reason = check_reached(posterior_of(log_density, draws), PEAK, 0.0, np.random.default_rng(3))
    assert ("never reached the posterior" in reason) is not reached


def test_the_height_decides_for_a_noisy_likelihood():
    draws = autoregressive((4, 500, K), 0.5, np.random.default_rng(2))
    posterior = posterior_of(narrow(45.0), draws, is_noisy=True)
    assert "45 nats above" not in check_reached(posterior, PEAK + 1, 0.0, np.random.default_rng(3))
    assert "nats above" in check_reached(posterior, PEAK, 0.0, np.random.default_rng(3))


def test_the_neck_of_a_funnel_is_no_unvisited_posterior():
    target, rng = Funnel(8), np.random.default_rng(4)
    posterior = target.posterior((4, 500), rng)
    neck = np.zeros(8)
    neck[0] = -30.0
    assert posterior.log_density.max() + 25 < target.log_density(neck[None])[0]
    assert check_reached(posterior, neck, target.log_evidence, rng) == ""


def test_an_evidence_of_chains_that_were_elsewhere_has_no_error():
    """Chains at the level of the prior, 500 nats below: the search for the maximum finds it."""
    draws = xr.Dataset(
        {"mu": (("chain", "draw"), 5 + 1e-2 * np.random.default_rng(5).standard_normal((4, 500)))}
    )
    idata = xr.DataTree.from_dict({"posterior": draws})
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 10)
        pm.Normal("y", mu, 0.15, observed=[0.2, -0.1])
    with pytest.warns(psf.errors.EvidenceWarning, match="never reached the posterior"):
        found = psf.estimate_evidence(idata, model, random_seed=1, progressbar=False)
    for evidence in found.values():
        assert np.isnan(evidence.se)
        assert "nats above that of the best draw" in evidence.doubts
    with pytest.raises(psf.errors.ModelError, match="never reached the posterior"):
        psf.compare_evidence({"one": idata, "other": idata})
