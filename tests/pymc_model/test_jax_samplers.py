"""The samplers of JAX on models with state-space variables: exact posteriors, and who refuses."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.special import logsumexp
from scipy.stats import halfnorm, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import GradientUnavailableError
from tests.systems import FORCE, FORCED, FORCED_DATA, FREE, STEPS, forced_terms
from tests.test_public_names import run_code_of

jax = pytest.importorskip("jax")
# Before the samplers: PyMC sets the number of JAX's devices here, and they make JAX count them.
pymc_jax = pytest.importorskip("pymc.sampling.jax")
pytest.importorskip("numpyro")
blackjax = pytest.importorskip("blackjax")
pytest.importorskip("nutpie")

pytestmark = pytest.mark.usefixtures("interpreted")

QUIET = {
    "chains": 2, "random_seed": 1, "progressbar": False, "quiet": True,
    "compute_convergence_checks": False,
}  # fmt: skip
PRIOR_MEAN, PRIOR_SD = 0.5, 0.4
GRID = np.linspace(-1.5, 2.0, 701)


def forced_model(filter=psf.EKF()):  # noqa: B008 (settings are frozen)
    with pm.Model() as model:
        pm.Normal("a", PRIOR_MEAN, PRIOR_SD)
        psf.StateSpace("d", FORCED, filter, steps=STEPS, observed=FORCED_DATA, inputs=FORCE)
    return model


def by_numpyro(draws, **nuts):
    return pm.sample(draws, tune=200, nuts_sampler="numpyro", nuts=nuts, **QUIET)


def by_blackjax(draws):
    return pm.sample(draws, tune=200, nuts_sampler="blackjax", **QUIET)


def by_nutpie(draws, gradient_backend):
    return pm.sample(
        draws, tune=200, nuts_sampler="nutpie", backend="jax", cores=2,
        compile_kwargs={"gradient_backend": gradient_backend}, **QUIET,
    )  # fmt: skip


SAMPLERS = {
    "numpyro": by_numpyro,
    "numpyro, vectorized": lambda draws: by_numpyro(draws, chain_method="vectorized"),
    "blackjax": by_blackjax,
    "nutpie, gradient by JAX": lambda draws: by_nutpie(draws, "jax"),
    "nutpie, gradient by PyTensor": lambda draws: by_nutpie(draws, "pytensor"),
}


@pytest.fixture(scope="module")
def log_density():
    """Of prior and record on the grid, by exact Kalman likelihoods."""
    return norm(PRIOR_MEAN, PRIOR_SD).logpdf(GRID) + [forced_terms(a).sum() for a in GRID]


def ranks(draws, grid, log_density):
    """P(a < draw | d), by quadrature."""
    mass = np.cumsum(np.exp(log_density - log_density.max()))
    return np.interp(draws, grid, mass / mass[-1])


def check_posterior(idata, model, grid, log_density):
    """The ranks of the draws are uniform: mean and variance within 4.5 standard errors.

    One of the ten comparisons of correct samplers fails in one of 15 000 sets of seeds. The
    evidence by the same draws is that of the quadrature.
    """
    evidence = psf.chib_jeliazkov(idata, model, random_seed=1, progressbar=False)
    exact = logsumexp(log_density) + np.log(grid[1] - grid[0])
    assert abs(evidence.log_evidence - exact) < 4.5 * evidence.se < 0.3
    (name,) = idata["posterior"].data_vars
    centred = ranks(idata["posterior"][name].to_numpy(), grid, log_density) - 0.5
    for values, mean, variance in ((centred, 0.0, 1 / 12), (centred**2, 1 / 12, 1 / 180)):
        effective = float(az.ess(values))
        assert effective > 120
        assert abs(values.mean() - mean) < 4.5 * np.sqrt(variance / effective)


@pytest.mark.parametrize(
    "name", [pytest.param("numpyro", marks=pytest.mark.slow), "nutpie, gradient by PyTensor"]
)
def test_each_sampler_has_the_exact_posterior(name, log_density):
    """One that the page on JAX does not call, and one on the system whose state is pushed."""
    with forced_model() as model:
        idata = SAMPLERS[name](500)
    check_posterior(idata, model, GRID, log_density)


def test_the_samplers_of_the_page_on_jax_have_the_exact_posterior():
    """Of a linear system, whose likelihood the Kalman filter has: a rate and its prior."""
    names = run_code_of("docs/howto/jax.md")
    rates = np.linspace(1e-3, 3.0, 1001)
    terms = psf.log_likelihood(
        names["relaxation"], psf.EKF(), {"rate": rates}, names["record"]["observations"],
        steps=names["steps"],
    )  # fmt: skip
    log_density = halfnorm.logpdf(rates) + terms.sum(axis=1)
    for sampler in ("numpyro", "blackjax", "nutpie"):
        check_posterior(names[f"by_{sampler}"], names["model"], rates, log_density)


@pytest.mark.parametrize("name", SAMPLERS)
def test_each_sampler_refuses_estimates_and_names_others(name):
    with (
        forced_model(psf.BootstrapPF(20)),
        pytest.raises(GradientUnavailableError, match=r"pm\.sample\(step=psf\.DRAM\(\)\)"),
    ):
        SAMPLERS[name](10)


def test_chains_of_a_long_record_run_at_once():
    """Where JAX copies arrays for a call, long ones have made such chains wait forever."""
    steps = np.arange(1, 5001)
    record = psf.simulate(FREE, {"a": 0.7}, steps=steps, random_seed=1)["observations"]
    with pm.Model():
        pm.Uniform("a", 0, 1)
        psf.StateSpace("d", FREE, psf.EKF(), steps=steps, observed=record)
        idata = pm.sample(20, tune=50, nuts_sampler="numpyro", **QUIET | {"chains": 4})
    assert abs(idata["posterior"]["a"] - 0.7).max() < 0.1  # a standard deviation is 0.013


def assert_fits(draws, log_density):
    """The posterior is nearly normal, and its approximation nearly the posterior."""
    found = ranks(np.ravel(draws), GRID, log_density)
    assert abs(found.mean() - 0.5) < 0.1
    assert abs(found.var() - 1 / 12) < 0.03


# PyTensor warns at each function of JAX that draws; users see it once.
@pytest.mark.filterwarnings("ignore:The RandomType SharedVariables:UserWarning")
def test_variational_inference(log_density):
    with forced_model():
        fit = pm.fit(
            2000, obj_optimizer=pm.adam(learning_rate=0.02), random_seed=1, progressbar=False,
            compile_kwargs={"mode": "JAX"},
        )  # fmt: skip
    assert_fits(fit.sample(1000, random_seed=1)["posterior"]["a"], log_density)


def test_pathfinder(log_density):
    logp = pymc_jax.get_jaxified_logp(forced_model())
    key = jax.random.key(1)
    start = [jax.numpy.array(0.5)]
    state = jax.jit(lambda key: blackjax.vi.pathfinder.approximate(key, logp, start)[0])(key)
    draws, _ = blackjax.vi.pathfinder.sample(key, state, 1000)
    assert_fits(draws[0], log_density)
