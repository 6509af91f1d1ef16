"""Evidence from draws whose noise moved along the chain: no seed gives their estimates again."""

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.graph_rewrites import smooth_filters
from tests.systems import autoregression, simulated

STEPS = np.arange(1, 31)
LINEAR = autoregression()
KNOWN = {"spread": np.sqrt(0.3)}
OBSERVED = simulated(STEPS, 3, phi=0.8, **KNOWN)


def model_with(filter):
    with pm.Model() as model:
        pm.Uniform("phi", -1, 1)
        psf.StateSpace("d", LINEAR, filter, params=KNOWN, steps=STEPS, observed=OBSERVED)
    return model


def test_the_evidence_is_that_of_the_exact_likelihood():
    """4 standard errors: one false alarm in 16 000 seeds; the exact number by quadrature."""
    phi = np.linspace(-1, 1, 4001)[1:-1]
    params = {"phi": phi, **KNOWN}
    terms = psf.log_likelihood(LINEAR, psf.EKF(), params, OBSERVED, steps=STEPS).sum(axis=-1)
    truth = np.log(np.mean(np.exp(terms - terms.max()))) + terms.max()
    with model_with(psf.BootstrapPF(40)) as noisy:
        idata = psf.sample_dram(
            2000,
            chains=2,
            kernel={"stages": 1, "correlation": 0.9},
            random_seed=1,
            progressbar=False,
        )
        found = psf.chib_jeliazkov(idata, random_seed=1)
    assert "d_seed" not in idata["sample_stats"]
    assert np.all(idata["sample_stats"]["correlation"] == 0.9)
    assert smooth_filters(noisy) == {
        "d": psf.BootstrapPF(40, resampling="sorted", resample_below=1)
    }
    assert abs(found.log_evidence - truth) < 4 * found.se
    assert found.se < 0.2
