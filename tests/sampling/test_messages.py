"""Settings of chains that cannot be, as (call, arguments, message); nothing is sampled."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.target.target import Target
from tests.kernels import with_kernel
from tests.sampling.test_dram import simple_model
from tests.systems import autoregression


def noisy_model():
    with pm.Model() as model:
        pm.Normal("phi")
        psf.StateSpace(
            "d", autoregression(spread=0.7), psf.BootstrapPF(30), steps=[1, 2], observed=[0.1, 0.3]
        )
    return model


def inside(make_model, call):
    """The call inside a model."""

    def in_model(**arguments):
        with make_model():
            return call(**arguments)

    return in_model


def run_chains(**arguments):
    settings = {"draws": 200, "tune": 200, "chains": 2, "cores": 2, "random_seed": 1}
    return psf.sample_dram(
        **with_kernel({"model": simple_model(), "progressbar": False} | settings | arguments)
    )


def by_nuts(**arguments):
    return psf.sample(sampler="nuts", **{"model": simple_model(), "progressbar": False} | arguments)


def run_in_model(**arguments):
    return psf.sample_dram(**with_kernel(arguments))


def suggest(**arguments):
    return psf.suggest_particles(noisy_model(), **arguments)


def run_models(**arguments):
    return psf.run_models(
        sampler="dram",
        **with_kernel({"models": {"a": simple_model()}, "progressbar": False} | arguments),
    )


step, noisy_step = inside(simple_model, psf.DRAM), inside(noisy_model, psf.DRAM)
noisy_chains = inside(noisy_model, run_in_model)
find_starts = inside(simple_model, psf.find_starts)

TABLE = [
    # the step method
    (step, {"stages": 0}, r"stages must be .* got 0$"),
    (step, {"stages": (2, 1, 1)}, r"stages must be .* got \(2, 1, 1\)"),
    (step, {"stages": 1.5}, r"stages must be .* got 1\.5"),
    (step, {"stages": True}, r"stages must be .* got True"),
    (step, {"stage_scale": 0.0}, r"stage_scale must be a positive number, got 0\.0"),
    (step, {"stage_scale": np.nan}, r"stage_scale must be .* got nan"),
    (step, {"adaptation": "haario"}, "must be one of 'chain', 'continuous', got 'haario'"),
    (step, {"adapt_every": 2}, r"adapt_every must be an integer of at least 4, got 2"),
    (step, {"adapt_every": 50.0}, r"adapt_every must be .* got 50\.0"),
    (step, {"refresh_noise": "yes"}, r"refresh_noise must be True or False, got 'yes'"),
    (step, {"proposal_cov": np.eye(3)}, r"proposal_cov .* 2 x 2 matrix, got shape \(3, 3\)"),
    (step, {"proposal_cov": [[1.0, 0.5], [0.0, 1.0]]}, r"proposal_cov .*a symmetric .* got \[\["),
    (step, {"proposal_cov": [[1.0, 2.0], [2.0, 1.0]]}, r"proposal_cov .* definite .* got \[\["),
    (step, {"proposal_cov": [[1, np.nan], [np.nan, 1]]}, r"proposal_cov .* definite .* got \[\["),
    (step, {"proposal_cov": "wide"}, r"proposal_cov must be .* got 'wide'"),
    # noise and screens, by both entry points
    *(
        (call, settings, message)
        for call in (noisy_step, noisy_chains)
        for settings, message in [
            ({"correlation": 0.9}, r"stages must be 1 with correlation=0\.9, got \(2, 1\).*cancel"),
            ({"correlation": 0.9, "stages": 2}, r"stages must be 1 .* got \(2, 2\)"),
            (
                {"correlation": 0.9, "stages": 1, "screen": psf.EnKF(20)},
                r"screen must be a filter without noise with correlation=0\.9, got EnKF",
            ),
            (
                {"correlation": 0.9, "stages": 1, "refresh_noise": False},
                r"refresh_noise must be True with correlation=0\.9, got False",
            ),
            ({"correlation": False}, r"correlation must be .* got False"),
            (
                {"correlation": 1.0, "stages": 1},
                r"correlation must be a number between 0 and 1, or None, got 1\.0",
            ),
            ({"correlation": -0.1, "stages": 1}, r"correlation must be .* got -0\.1"),
            ({"correlation": np.nan, "stages": 1}, r"correlation must be .* got nan"),
            ({"correlation": True, "stages": 1}, r"correlation must be .* got True"),
            ({"screen": "EKF"}, r"filter such as psf\.EKF\(\), or None, got 'EKF'"),
            ({"screen": psf.EKF}, r"screen must be a filter .* got <class .*EKF'>"),
            (
                {"screen": "EKF", "correlation": 0.9, "stages": 1},
                r"screen must be a filter .* got 'EKF'",
            ),
            (
                {"screen": psf.EKF(), "screen_power": 0},
                r"screen_power must be a number in \(0, 1\], got 0",
            ),
            ({"screen": psf.EKF(), "screen_power": 2}, r"screen_power must be .* got 2"),
            ({"screen": psf.EKF(), "screen_power": np.nan}, r"screen_power must be .* got nan"),
        ]
    ),
    # chains
    (run_chains, {"draws": -1}, r"draws must be an integer of at least 0, got -1"),
    (run_chains, {"tune": 1.5}, r"tune must be .* got 1\.5"),
    (run_chains, {"draws": 0}, r"got draws=0, tune=200, discard_tuned_samples=True"),
    (run_chains, {"draws": 0, "tune": 0, "discard_tuned_samples": False}, r"draws=0, tune=0"),
    (run_chains, {"chains": 0}, r"chains must be an integer of at least 1, got 0"),
    (run_chains, {"cores": 0}, r"cores must be None or an integer of at least 1, got 0"),
    (run_chains, {"random_seed": -1}, r"random_seed must be .* got -1"),
    (run_chains, {"random_seed": [1, 2]}, r"random_seed must be None, a non-neg.* got \[1, 2\]"),
    (run_chains, {"initvals": [{"mu": 1.0}]}, "one entry for each chain, got 1 for chains=2"),
    (run_chains, {"initvals": "prior"}, r"initvals must be None, a mapping .* got 'prior'"),
    (run_chains, {"initvals": {"nu": 1.0}}, "free variables of the model, mu, sigma, got 'nu'"),
    (run_chains, {"initvals": {"mu": [1.0, 2.0]}}, r"'mu' must have shape \(\), got \(2,\)"),
    (run_chains, {"initvals": {"mu": "x"}}, r"'mu' must be numbers, .* got 'x'"),
    *(
        (call, {"initvals": values}, r"'sigma' .* HalfNormal prior, \(0, inf\), got -1\.0$")
        for call, values in (
            (run_chains, [{"sigma": 1.0}, {"sigma": -1.0}]),
            (by_nuts, {"sigma": -1.0}),
        )
    ),
    (run_chains, {"stages": 0}, r"stages must be .* got 0"),
    (run_chains, {"model": 3}, r"model must be a pymc.Model, got int"),
    (run_chains, {"checkpoint": 3}, r"checkpoint must be the path of a folder, got 3"),
    (run_chains, {"checkpoint": ""}, r"checkpoint must be the path of a folder, got ''"),
    # chains that stop at an effective size
    *(
        (call, {"draws": 50} | settings, message)
        for call in (run_chains, run_models)
        for settings, message in [
            ({"until_ess": 0}, "until_ess must be a positive number, got 0"),
            ({"until_ess": -5.0}, "until_ess must be a positive number, got -5.0"),
            ({"until_ess": np.nan}, "until_ess must be a positive number, got nan"),
            ({"until_ess": "400"}, "until_ess must be a positive number, got '400'"),
            ({"max_draws": 500}, "max_draws needs until_ess, got max_draws=500 alone"),
            ({"until_ess": 400, "max_draws": 49}, "max_draws must be .* at least draws=50, got 49"),
            ({"until_ess": 400, "max_draws": 99.5}, "max_draws must be an integer .*, got 99.5"),
            (
                {"until_ess": 400, "draws": 0, "discard_tuned_samples": False},
                "draws with until_ess must be an integer of at least 1, got 0",
            ),
        ]
    ),
    # several models
    (run_models, {"models": [simple_model()]}, "models must be a non-empty mapping"),
    (run_models, {"models": {}}, r"models must be a non-empty mapping .* got \{\}"),
    (run_models, {"models": {1: simple_model()}}, "names of models must be .* got 1"),
    (run_models, {"models": {"": simple_model()}}, "names of models must be .* got ''"),
    (run_models, {"models": {"a": "b"}}, r"models\['a'\] must be a pymc.Model, got 'b'"),
    (run_models, {"gather": "some"}, "gather must be .* got 'some'"),
    (run_models, {"per_chain": 0}, "per_chain must be .* got 0"),
    (run_models, {"cores": 0}, "cores must be .* got 0"),
    (run_models, {"draws": -1}, "draws must be .* got -1"),
    # numbers of particles, and starts
    *(
        (suggest, {"target": target}, "target must be two positive numbers, .* got ")
        for target in [(3.3, 1.0), (0.0, 1.0), (1.0,), 2.0, (1, 2, 3), "ab", (1, None)]
    ),
    (find_starts, {"chains": 0}, "chains"),
    (find_starts, {"chains": 2.5}, "chains"),
    (find_starts, {"chains": 257}, "at most"),
]


@pytest.mark.parametrize(("call", "arguments", "message"), TABLE)
def test_a_wrong_argument_is_named(call, arguments, message):
    with pytest.raises(ModelError, match=message) as caught:
        call(**arguments)
    assert isinstance(caught.value, ValueError)


def test_a_step_method_is_refused():
    with pytest.raises(TypeError, match="unexpected keyword argument 'step'"):
        run_chains(step=None)


@pytest.mark.parametrize("call", [run_chains, run_models, by_nuts])
def test_another_bar_is_refused_before_anything_is_compiled(call, monkeypatch):
    monkeypatch.setattr(Target, "prepare", None)
    with pytest.raises(ModelError, match=r"True, False or one of .*'split\+stats'.* got 'text'"):
        call(progressbar="text")
