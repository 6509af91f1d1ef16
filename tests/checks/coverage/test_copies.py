"""Copies of the mode that chains are in are found with their masses, and nothing else is."""

import json
import re

import numpy as np
import pymc as pm
import pytest
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.coverage.copies import LEAPS, missed_copy

SD, N = 0.03, 500
# The modes with their masses; the first is that of the chains, and the second the largest other.
SHIFTED = {(1.3, 0.4): 0.55, (4.98, 0.4): 0.3, (7.58, 0.4): 0.15}
NEGATIVE = {(1.5, -0.8, 0.3): 0.5, (-1.5, 0.8, 0.3): 0.5}
EXCHANGED = {(2.0, -2.0, 0.5, 1.0): 0.5, (-2.0, 2.0, 1.0, 0.5): 0.5}
TURNED = {(1.2, 0.8): 0.6, (-1.2, 0.8 - np.pi): 0.4}
ALL = [(SHIFTED, [(), ()]), (NEGATIVE, [()] * 3), (EXCHANGED, [(2,)] * 2), (TURNED, [(), ()])]


class Modes:
    """Normal distributions; ``n_evaluated`` counts the points."""

    def __init__(self, modes):
        self.centres, self.masses = np.array(list(modes)), np.array(list(modes.values()))
        self.n_evaluated = 0

    def __call__(self, x, rng=None):
        self.n_evaluated += len(x)
        k = x.shape[1]
        squares = ((x[:, None] - self.centres) ** 2).sum(axis=-1) / SD**2
        return logsumexp(np.log(self.masses) - squares / 2, axis=1) - k * np.log(SD * 2.507)

    def drawn(self, masses, rng, spread=1.0):
        which = rng.choice(len(masses), (4, N), p=masses)
        z = rng.standard_normal((4, N, self.centres.shape[1]))
        return self.centres[which] + spread * SD * z


def looked(modes, shapes, seed, share=None, n=20_000):
    """What is found of draws in the first mode, or in all by these shares."""
    target, rng = Modes(modes), np.random.default_rng(seed)
    masses = np.eye(len(modes))[0] if share is None else share
    draws = target.drawn(masses, rng)
    log_density = np.stack([target(one) for one in draws])
    target.n_evaluated = 0
    prior = 3.0 * rng.standard_normal((100, draws.shape[-1]))
    return missed_copy(draws, log_density, prior, shapes, target, n, rng), target


@pytest.mark.parametrize(("modes", "shapes"), ALL)
def test_a_copy_that_no_chain_has_met_is_found_with_its_mass(modes, shapes):
    """In 12 of 12 runs: a shift, two signs, two labels, a sign with a half turn."""
    other, (p, q, *_) = list(modes)[1], modes.values()
    for seed in range(3):
        found, _ = looked(modes, shapes, seed)
        np.testing.assert_allclose(found.centre, other, atol=SD)
        assert found.share == 0.0
        assert found.posterior == pytest.approx(q / (p + q), abs=0.08)


@pytest.mark.parametrize(("modes", "shapes"), ALL)
def test_draws_of_all_modes_lack_none(modes, shapes):
    """No alarm in 20 runs; a rate of 14 % fails 19 times in 20."""
    for seed in range(5):
        assert looked(modes, shapes, seed, share=list(modes.values()))[0] is None


def test_a_look_that_finds_nothing_keeps_to_its_part_of_the_evaluations():
    for n in (1500, 20_000):
        found, target = looked({(1.3, 0.4, 0.2): 1.0}, [()] * 3, 1, n=n)
        assert found is None
        assert 0 < target.n_evaluated <= LEAPS * n
    assert looked(SHIFTED, [(), ()], 1, n=1000)[1].n_evaluated == 0


def test_a_part_without_a_dip_is_no_separate_mode():
    """The draws end at half of a mode, whose other half is a reflection."""
    rng = np.random.default_rng(1)
    target = Modes({(0.0, 0.4): 1.0})
    draws = target.drawn([1.0], rng)
    draws[..., 0] = abs(draws[..., 0])
    log_density = np.stack([target(one) for one in draws])
    prior = 3.0 * rng.standard_normal((100, 2))
    assert missed_copy(draws, log_density, prior, [(), ()], target, 20_000, rng) is None


def test_chains_at_one_of_the_frequencies_that_look_alike_once_a_period(caplog):
    """The likelihood is the same at 2 pi - w, so that the priors there are the masses."""
    system = psf.StateSpaceModel(
        psf.ExactLinear(lambda d, w: [[-d, -w], [w, -d]], lambda: 0.1 * np.eye(2), dt=1.0),
        observation=lambda x: [x[0]],
        observation_noise=[[0.01]],
        initial_mean=[1.0, 0.0],
        initial_cov=np.eye(2),
    )
    steps, truth = range(1, 91), {"d": 0.02, "w": 1.3}
    record = psf.simulate(system, truth, steps=steps, random_seed=1)["observations"]
    with pm.Model() as model:
        pm.Gamma("w", 2, 0.5)
        pm.HalfNormal("d", 0.5)
        psf.StateSpace("y", system, psf.EKF(), steps=steps, observed=record)
    kwargs = {"initvals": truth, "random_seed": 1, "progressbar": False, "cores": 1}
    idata = psf.sample_dram(1000, model=model, **kwargs)
    (said,) = json.loads(idata.attrs["unvisited"])
    place, share = re.search(r"w = ([\d.]+), .* at least ([\d.]+)% of the posterior", said).groups()
    at, w = float(place), idata["posterior"]["w"].mean().item()
    assert at == pytest.approx(2 * np.pi - w, abs=0.03)
    prior = np.exp(pm.logp(pm.Gamma.dist(2, 0.5), np.array([w, at])).eval())
    assert float(share) / 100 == pytest.approx(prior[1] / prior.sum(), abs=0.06)  # 0.378
    assert "psf.sample_smc(10_000, model=model)" in caplog.text
