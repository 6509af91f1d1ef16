"""Every filter that a message recommends takes the very system, and is not the one in use."""

import re
import warnings

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.choice import jump_problem
from pymc_statespace_filters.advice.collapse import collapse_remedies, collapse_remedy
from pymc_statespace_filters.advice.refusals import alternatives
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.catalog import filters_for, quiet_filter
from pymc_statespace_filters.filters.written import short_form

PARTICLES = {"GuidedPF", "BootstrapPF", "PFEnKF"}
GAUSSIAN = {"EKF", "UKF", "IPLF"}


def system(**changes):
    settings = dict(
        transition=lambda x, q: 0.9 * pt.sin(x[0]) + q[0], process_noise=1.0,
        observation=lambda x: x[0], observation_noise=0.1, initial_mean=0.0, initial_cov=1.0,
    )  # fmt: skip
    return psf.StateSpaceModel(**{k: v for k, v in (settings | changes).items() if v is not ...})


TWO = dict(initial_mean=[0.0, 0.0], initial_cov=np.eye(2))
COUNTS = dict(
    observation=..., observation_noise=...,
    observation_dist=lambda x: pm.Poisson.dist(pt.exp(x[0])),
)  # fmt: skip
DENSITY = dict(
    observation=..., observation_noise=..., observation_logp=lambda d, x: -abs(d[0] - x[0])
)
SYSTEMS = {
    "one state": (system(), PARTICLES | GAUSSIAN | {"EnKF", "GridFilter"}),
    "linear": (
        system(transition=lambda x, q: 0.9 * x[0] + q[0]),
        PARTICLES | GAUSSIAN | {"EnKF", "GridFilter"},
    ),
    "three states": (
        system(
            transition=lambda x, q: [x[1], x[2], pt.sin(x[0]) + q[0]],
            initial_mean=[0.0, 0.0, 0.0], initial_cov=np.eye(3),
        ),
        PARTICLES | GAUSSIAN | {"EnKF"},
    ),
    "carried": (
        system(
            transition=lambda x, q: [x[0] + q[0], pt.sign(x[0])], states=["z", "side"],
            carried=["side"], **TWO,
        ),
        PARTICLES | {"EnKF"},
    ),
    "counts": (system(**COUNTS), PARTICLES | {"IPLF", "GridFilter"}),
    "density": (system(**DENSITY), PARTICLES | {"GridFilter"}),
    "no noise": (
        system(transition=lambda x: pt.sin(x[0]), process_noise=...),
        PARTICLES | GAUSSIAN | {"EnKF"},
    ),
    "regimes": (
        system(
            transition=lambda x, q: [0.9 * x[0] + q[0] + q[1], q[0]], process_noise=...,
            process_dist=lambda x: [pm.Bernoulli.dist(0.2 + 0.6 * x[1]), pm.Normal.dist(0.0, 1.0)],
            states=["z", "regime"], carried=["regime"], initial_mean=[0.0, 0.0],
            initial_cov=np.diag([1.0, 0.0]),
        ),
        {"BootstrapPF", "IMM", "RBPF"},
    ),
}  # fmt: skip


def kinds(filters):
    return {type(f).__name__ for f in filters}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_refusal_names_the_filters_that_take_the_system(name):
    model, expected = SYSTEMS[name]
    compiled = compile_system(model)
    assert kinds(filters_for(compiled)) == expected
    for filter in (psf.EKF(), psf.EnKF(10), psf.IPLF(), psf.GridFilter()):
        if type(filter).__name__ in expected:
            continue
        with pytest.raises(psf.errors.ModelError) as caught:
            psf.log_likelihood(model, filter, {}, [1.0], steps=[1])
        for known in kinds(filters_for(compile_system(SYSTEMS["one state"][0]))):
            recommended = re.search(rf"\b{known}\(", str(caught.value)) is not None
            assert recommended == (known in expected), (known, str(caught.value))


@pytest.mark.parametrize(
    ("name", "filter", "words"),
    [
        ("one state", psf.BootstrapPF(50), r"Use GridFilter\(\), which computes this likelihood"),
        ("linear", psf.GuidedPF(50), r"Use EKF\(\), which computes this likelihood without"),
        ("counts", psf.GuidedPF(50), r"Use GridFilter\(\)"),
        ("three states", psf.BootstrapPF(50), r"Use GuidedPF\(100\), .*more particles"),
        ("three states", psf.GuidedPF(50), "Use more particles; psf.suggest_particles"),
        ("carried", psf.EnKF(50), r"Use GuidedPF\(100\)"),
    ],
)
def test_the_remedy_of_a_collapse_works_for_the_system(name, filter, words):
    model, expected = SYSTEMS[name]
    remedy = collapse_remedy(compile_system(model), filter)
    assert re.match(words, remedy), remedy
    for known in PARTICLES | GAUSSIAN | {"EnKF", "GridFilter"}:
        recommended = re.search(rf"\b{known}\(", remedy)
        assert not recommended or known in expected - {type(filter).__name__}


def test_filters_of_regimes_are_recommended_where_a_system_switches():
    def noise(x):
        regime = pm.Bernoulli.dist(pt.switch(x[1] > 0.5, 0.9, 0.1))
        return [regime, pm.Normal.dist(0.0, 1.0)]

    switching = system(
        transition=lambda x, q: [pt.switch(q[0] > 0.5, 0.9, 0.2) * x[0] + q[1], q[0]],
        process_noise=..., process_dist=noise, **TWO | dict(initial_cov=np.diag([1.0, 0.0])),
    )  # fmt: skip
    compiled = compile_system(switching)
    assert kinds(filters_for(compiled)) == {"IMM", "RBPF", "BootstrapPF", "EnKF"}
    assert jump_problem(compiled, psf.EKF()) == (
        "EKF(): this system switches between regimes, which no linearisation follows, and the "
        "log-likelihood may be far off; use IMM(), RBPF(100) or BootstrapPF(1000)."
    )
    assert jump_problem(compiled, psf.IMM()) is None


def test_a_filter_is_exact_or_approximate():
    text = alternatives(compile_system(SYSTEMS["linear"][0]), psf.UKF())
    assert text == (
        "this system can be treated by EKF(), GridFilter(), IPLF(), GuidedPF(100), "
        "BootstrapPF(1000) (exact) and by PFEnKF(1000), EnKF(1000) (approximate)"
    )


@pytest.mark.parametrize(
    ("filter", "text"),
    [
        (psf.EKF(), "EKF()"),
        (psf.GuidedPF(100), "GuidedPF(100)"),
        (psf.GuidedPF(100, resampling="sorted"), "GuidedPF(100, resampling='sorted')"),
        (psf.EnKF(20, likelihood="gaussian"), "EnKF(20, likelihood='gaussian')"),
        (psf.UKF(alpha=0.5), "UKF(alpha=0.5)"),
        (psf.GridFilter(), "GridFilter()"),
        ("another filter", "another filter"),
        (psf.EKF, str(psf.EKF)),
    ],
)
def test_a_filter_is_written_as_a_user_writes_it(filter, text):
    assert short_form(filter) == text


def test_every_noisy_filter_of_a_model_has_its_remedy():
    with pm.Model() as model:
        psf.StateSpace("one", SYSTEMS["one state"][0], psf.BootstrapPF(9), steps=[1], observed=[1])
        psf.StateSpace("exact", SYSTEMS["one state"][0], psf.EKF(), steps=[1], observed=[1])
        alone = collapse_remedies(model)
        psf.StateSpace("many", SYSTEMS["three states"][0], psf.GuidedPF(9), steps=[1], observed=[1])
    assert alone.startswith("Use GridFilter()")
    both = collapse_remedies(model)
    assert both.startswith("For 'one': Use GridFilter()")
    assert "For 'many': Use more particles" in both
    assert "exact" not in both


def test_a_gradient_is_offered_by_filters_that_take_the_system():
    with pm.Model() as model:
        pm.Normal("free")
        counts = system(**COUNTS, transition=lambda x, q, free: free * x[0] + q[0])
        psf.StateSpace("d", counts, psf.BootstrapPF(9), steps=[1], observed=[1])
        with pytest.raises(
            psf.errors.GradientUnavailableError, match=r"BootstrapPF\(9\)"
        ) as caught:
            model.dlogp()
    assert "gradient: IPLF()." in str(caught.value)
    assert "EKF" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "filter", "expected"),
    [
        (dict(transition=lambda x, q: 0.9 * x[0] + q[0]), psf.BootstrapPF(9), psf.EKF()),
        ({}, psf.BootstrapPF(9), psf.GridFilter()),
        ({}, psf.GuidedPF(9), psf.GridFilter()),
        (TWO | dict(process_noise=np.eye(2)), psf.BootstrapPF(9), psf.GuidedPF(100)),
        (TWO | dict(process_noise=np.eye(2)), psf.GuidedPF(9), None),
    ],
)
def test_a_filter_of_the_same_likelihood_with_less_noise(changes, filter, expected):
    if "initial_mean" in changes:
        changes = changes | dict(transition=lambda x, q: [pt.sin(x[1]) + q[0], x[0] + q[1]])
    assert quiet_filter(compile_system(system(**changes)), filter) == expected


def test_a_sensor_of_a_product_is_not_sent_to_a_guide():
    """More plain particles find the log-likelihood that 1e5 do; 100 guided ones lie far below."""
    product = psf.StateSpaceModel(
        transition=lambda x, q: 0.9 * x + 0.5 * q, process_noise=np.eye(2),
        observation=lambda x: [x[0] * x[1]], observation_noise=[[0.01]],
        initial_mean=[0.5, 0.5], initial_cov=np.eye(2),
    )  # fmt: skip
    remedy = collapse_remedy(compile_system(product), psf.BootstrapPF(1000))
    assert remedy.startswith("Use more particles; psf.suggest_particles finds how many. GuidedPF")
    steps = np.arange(1, 31)
    observed = psf.simulate(product, {}, steps=steps, random_seed=3)["observations"].values

    def log_likelihood(filter, n_seeds):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", psf.errors.FilterWarning)
            terms = psf.log_likelihood(
                product, filter, {}, observed, steps=steps, seed=np.arange(n_seeds)
            )
        return np.median(terms.sum(axis=1))

    true = log_likelihood(psf.BootstrapPF(100_000), 3)
    assert log_likelihood(psf.BootstrapPF(20_000), 5) == pytest.approx(true, abs=1.0)
    assert log_likelihood(psf.GuidedPF(100), 20) < true - 4.0


def test_a_linear_sensor_is():
    linear = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + 0.5 * q[0], x[1] - 0.1 * x[1] ** 3 + q[1]],
        process_noise=np.eye(2), observation=lambda x: [x[0] + x[1]], observation_noise=[[0.01]],
        initial_mean=[0.5, 0.5], initial_cov=np.eye(2),
    )  # fmt: skip
    remedy = collapse_remedy(compile_system(linear), psf.BootstrapPF(1000))
    assert remedy.startswith("Use GuidedPF(100), which moves particles to the data")
