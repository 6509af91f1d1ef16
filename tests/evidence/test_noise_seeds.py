"""A noisy likelihood whose noise is a known function of a shared seed, inside a PyMC model."""

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import norm

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence import chib_jeliazkov
from pymc_statespace_filters.pymc_model import density

SD = 1.2
Y = 0.7
LOG_EVIDENCE = norm.logpdf(Y, scale=np.sqrt(2.0))
HELD = 1234


def log_noise(seed, lib=np):
    """N(-SD^2/2, SD^2) over seeds, so that its exponential has mean one; for NumPy and PyTensor."""
    small = (seed % 1_000_003) + 1.0
    u, v = (lib.sin(small * salt) * 43758.5453 for salt in (12.9898, 78.233))
    u, v = u - lib.floor(u), v - lib.floor(v)
    normal = lib.sqrt(-2 * lib.log(u + 1e-12)) * lib.cos(2 * np.pi * v)
    return SD * normal - SD**2 / 2


@pytest.fixture(scope="module")
def model():
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        pm.Normal("y", mu, 1, observed=[Y])
        seed = pytensor.shared(np.array(HELD, dtype=np.int64), name="d_seed")
        pm.Potential("noise", log_noise(seed, pt))
        model.seed = seed
    return model


@pytest.fixture(autouse=True)
def _seeds_are_found(monkeypatch):
    def noise_seeds(model):
        return {"d": model.seed} if hasattr(model, "seed") else {}

    monkeypatch.setattr(density, "noise_seeds", noise_seeds)


def log_density(mu, seed):
    return norm.logpdf(mu) + norm.logpdf(Y, mu) + log_noise(seed)


def draws(rng, seeds):
    mu = Y / 2 + rng.standard_normal(seeds.shape) / np.sqrt(2)
    return {
        "posterior": {"mu": mu},
        "sample_stats": {"d_seed": seeds, "lp": log_density(mu, seeds)},
    }


@pytest.fixture
def refreshed():
    """Draws of the chain's stationary law: a seed is kept in proportion to its likelihood."""
    rng = np.random.default_rng(2)
    candidates = rng.integers(2**62, size=400_000)
    weights = np.exp(log_noise(candidates))
    seeds = rng.choice(candidates, size=(4, 5000), p=weights / weights.sum())
    return draws(rng, seeds)


def test_the_toy_noise_is_what_it_says():
    noise = log_noise(np.random.default_rng(3).integers(2**62, size=200_000))
    assert noise.std() == pytest.approx(SD, abs=0.02)
    assert np.exp(noise).mean() == pytest.approx(1.0, abs=0.02)


def test_refreshed_noise_gives_the_evidence_of_the_expected_likelihood(model, refreshed):
    evidence = chib_jeliazkov(az.from_dict(refreshed), model, random_seed=1, progressbar=False)
    assert evidence.noise == "refreshed"
    assert evidence.se < 0.03
    assert abs(evidence.log_evidence - LOG_EVIDENCE) < 4 * evidence.se
    # Not the luckiest of 20 000 estimates, which lies more than four standard deviations higher.
    assert evidence.max_log_likelihood == pytest.approx(norm.logpdf(Y, Y / 2), abs=1.0)


def test_stored_seeds_reproduce_a_log_density_that_was_not_stored(model, refreshed):
    kept = az.from_dict(refreshed)
    del refreshed["sample_stats"]["lp"]
    with_lp, without = (
        chib_jeliazkov(idata, model, random_seed=1, n_proposals=1000).log_evidence
        for idata in (kept, az.from_dict(refreshed))
    )
    assert without == pytest.approx(with_lp, abs=1e-9)


def test_a_held_seed_gives_that_seeds_evidence(model):
    seeds = np.full((4, 2000), 77)
    idata = az.from_dict(draws(np.random.default_rng(4), seeds))
    evidence = chib_jeliazkov(idata, model, random_seed=1)
    assert evidence.noise == "held"
    assert abs(log_noise(77)) > 0.1
    expected = LOG_EVIDENCE + log_noise(77)
    assert abs(evidence.log_evidence - expected) < 4 * evidence.se < 0.1
    assert idata["evidence"]["noise"].values == ["held"]


def test_without_stored_seeds_the_models_own_was_held(model):
    rng = np.random.default_rng(5)
    given = draws(rng, np.full((4, 2000), HELD))
    del given["sample_stats"]["d_seed"]
    evidence = chib_jeliazkov(az.from_dict(given), model, random_seed=1)
    assert evidence.noise == "held"
    assert abs(evidence.log_evidence - LOG_EVIDENCE - log_noise(HELD)) < 4 * evidence.se


def test_refreshed_noise_without_stored_seeds_is_an_error(model, refreshed):
    del refreshed["sample_stats"]["d_seed"]
    with pytest.raises(DataMismatchError, match="the draws belong to another model"):
        chib_jeliazkov(az.from_dict(refreshed), model)


def test_chains_of_different_held_seeds_are_refused(model):
    seeds = np.repeat([[1], [2]], 100, axis=1)
    with pytest.raises(ModelError, match="got 2 seeds in 2 chains"):
        chib_jeliazkov(az.from_dict(draws(np.random.default_rng(6), seeds)), model)


def test_the_models_seed_is_left_alone(model, refreshed):
    chib_jeliazkov(az.from_dict(refreshed), model, random_seed=1, n_proposals=200)
    assert model.seed.get_value() == HELD
