"""The posterior of a published case study: an ordinary differential equation by NUTS."""

import arviz as az
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from benchmarks.lynx_hare import NAMES, by_filter

# B. Carpenter, "Predator-prey population dynamics: the Lotka-Volterra model in Stan" (2018).
PUBLISHED = {
    "alpha": 0.54686, "beta": 0.02775, "gamma": 0.8001, "delta": 0.02409,
    "hare": 34.04, "lynx": 5.936, "s_hare": 0.2481, "s_lynx": 0.2510,
}  # fmt: skip


@pytest.mark.slow
def test_the_posterior_of_lynx_and_hare_is_the_published_one():
    """Means within a tenth of a posterior sd; the error of each is about 0.03 sd."""
    with by_filter():
        starts = psf.find_starts(chains=4, random_seed=1)
        idata = pm.sample(
            2000, chains=4, cores=1, init="adapt_diag", initvals=starts, nuts_sampler="pymc",
            random_seed=1, progressbar=False, quiet=True,
        )  # fmt: skip
    posterior = idata["posterior"]
    assert max(float(value) for value in az.rhat(idata).values()) < 1.02
    for name in NAMES:
        draws = posterior[name].values
        off = (draws.mean() - PUBLISHED[name]) / draws.std()
        assert abs(off) < 0.1, (name, off)
