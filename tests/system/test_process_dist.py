"""process_dist and initial_dist: laws of the draws, their Gaussian surrogate, and bad input."""

import pickle

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from pytensor.gradient import jacobian
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.symbols import call
from pymc_statespace_filters.system.distributions import LAWS, law_name
from tests.distributions import TABLE
from tests.modes import AS_IT_STANDS

SHARES = np.array([0.2, 0.5, 0.3])
COV = np.array([[2.0, 0.6], [0.6, 0.5]])
N_DRAWS = 100_000
LEAST_P = 1e-4  # over some 35 tests: a right implementation fails for 1 in 300 seeds


def system_of(*distributions, **arguments):
    """A system of 30 states, the first of which are the components of its process_dist."""
    return psf.StateSpaceModel(
        transition=lambda x, q: pt.concatenate([q, x[q.type.shape[0] :]]),
        process_dist=lambda x: [f(x[0]) for f in distributions],
        observation=lambda x: x[0],
        observation_noise=1.0,
        initial_dist=lambda: [0.7, *[0.0] * 29],
        **arguments,
    )


@pytest.fixture(scope="module")
def everything():
    return system_of(
        *(distribution for distribution, _ in TABLE.values()),
        lambda x: pm.Categorical.dist([0.2, x - 0.2, 0.3]),
        lambda x: pm.Multinomial.dist(40, pt.stack([0.2, x - 0.2, 0.3])),
        lambda x: pm.MvNormal.dist(pt.stack([x, 1.0]), COV),
    )


@pytest.fixture(scope="module")
def draws(everything):
    compiled = compile_system(everything)
    c = compiled.prepare.function(np.zeros(0))
    X = np.zeros((30, N_DRAWS))
    X[0] = 0.7
    Z = np.random.default_rng(1).normal(size=(compiled.m, N_DRAWS))
    compiled.propagate.function(c, np.zeros((1, 0)), 0, 0.0, Z, X)
    return X


def test_every_law_is_tested():
    vectors = {"Categorical", "Multinomial", "MvNormal"}
    assert set(TABLE) | vectors == set(map(law_name, LAWS))


@pytest.mark.parametrize(("place", "name"), list(enumerate(TABLE)))
def test_draws_have_their_law(draws, place, name):
    law, drawn = TABLE[name][1], draws[place]
    if hasattr(law.dist, "pdf"):
        assert stats.kstest(drawn, law.cdf).pvalue > LEAST_P
        return
    values = np.arange(law.ppf(1e-4), law.ppf(1 - 1e-4) + 1)
    np.testing.assert_array_equal(drawn, np.round(drawn))
    check_frequencies(np.clip(drawn, values[0], values[-1]), values, law)


def check_frequencies(drawn, values, law):
    expected = law.pmf(values)
    expected[0], expected[-1] = law.cdf(values[0]), law.sf(values[-1] - 1)
    counts = (drawn[:, None] == values).sum(axis=0)
    assert stats.chisquare(counts, N_DRAWS * expected / expected.sum()).pvalue > LEAST_P


def test_categories_and_their_counts_have_their_law(draws):
    category, counts = draws[20], draws[21:24]
    check_frequencies(category, np.arange(3), stats.rv_discrete(values=(range(3), SHARES)))
    np.testing.assert_array_equal(counts.sum(axis=0), 40.0)
    for k in range(3):
        values = np.arange(stats.binom.ppf(1e-4, 40, SHARES[k]), 25)
        drawn = np.clip(counts[k], values[0], 24)
        check_frequencies(drawn, values, stats.binom(40, SHARES[k]))
    covariance = 40 * (np.diag(SHARES) - np.outer(SHARES, SHARES))
    # The error of a covariance of 1e5 draws is about 0.03.
    np.testing.assert_allclose(np.cov(counts), covariance, atol=0.15)


def test_a_normal_vector_has_its_covariance(draws):
    vector = draws[24:26]
    np.testing.assert_allclose(vector.mean(axis=1), [0.7, 1.0], atol=0.02)
    np.testing.assert_allclose(np.cov(vector), COV, atol=0.05)


def test_the_surrogate_has_mean_and_covariance(everything):
    """The equations for Gaussian filters, linearised at zero normals."""
    gaussian = everything.gaussian
    x, z = pt.dvector("x"), pt.tensor("z", shape=(everything.m,), dtype="float64")
    x = pt.tensor("x", shape=(30,), dtype="float64")
    step = call(gaussian.equations.transition, gaussian, {"theta": pt.zeros((0,)), "x": x, "q": z})
    at = {x: np.r_[0.7, np.zeros(29)], z: np.zeros(everything.m)}
    mean = step.eval(at, mode=AS_IT_STANDS)
    jac = jacobian(step, z, vectorize=True).eval(at, mode=AS_IT_STANDS)
    laws = [law for _, law in TABLE.values()]
    np.testing.assert_allclose(mean[:20], [law.mean() for law in laws], rtol=1e-7)
    cov = jac @ jac.T
    np.testing.assert_allclose(cov[:20, :20], np.diag([law.var() for law in laws]), atol=1e-7)
    np.testing.assert_allclose(mean[20:26], [1.1, 8.0, 20.0, 12.0, 0.7, 1.0])
    np.testing.assert_allclose(cov[20, 20], 0.49)
    counts = 40 * (np.diag(SHARES) - np.outer(SHARES, SHARES))
    np.testing.assert_allclose(cov[21:24, 21:24], counts, atol=1e-9)
    np.testing.assert_allclose(cov[24:26, 24:26], COV)


def test_a_variable_may_depend_on_others():
    """A Poisson number of a gamma rate that is not returned is a negative binomial one."""

    def mixed(x):
        rate = pm.Gamma.dist(alpha=3.0, beta=3.0 / x)
        return pm.Poisson.dist(rate)

    system = system_of(mixed)
    assert system.m == 2
    found = one_step(system, 0.7, 40_000)
    np.testing.assert_array_equal(found, np.round(found))
    law = stats.nbinom(3.0, 3.0 / 3.7)
    assert abs(found.mean() - law.mean()) < 5 * law.std() / 200
    assert abs(found.var() - law.var()) < 0.1
    # The surrogate has the same mean and variance.
    gaussian = compile_system(system.gaussian)
    drawn = one_step(gaussian.model, 0.7, 40_000)
    assert abs(drawn.mean() - law.mean()) < 5 * law.std() / 200
    assert abs(drawn.var() - law.var()) < 0.1


def one_step(system, x, n):
    compiled = compile_system(system)
    X = np.zeros((30, n))
    X[0] = x
    Z = np.random.default_rng(2).normal(size=(compiled.m, n))
    c = compiled.prepare.function(np.zeros(0))
    compiled.propagate.function(c, np.zeros((1, 0)), 0, 0.0, Z, X)
    return X[0]


def test_constants_are_in_double_precision():
    """PyMC stores 1 / 3.0 with seven digits."""
    system = system_of(lambda x: pm.Exponential.dist(lam=3.0))
    assert one_step(system, 0.7, 1)[0] == pytest.approx(
        stats.expon.isf(stats.norm.sf(np.random.default_rng(2).normal())) / 3.0, rel=1e-13
    )


def test_a_bad_parameter_on_the_way_is_a_failure():
    distributions = [
        lambda x: pm.Poisson.dist(x),
        lambda x: pm.Binomial.dist(5, x),
        lambda x: pm.Normal.dist(0.0, x),
        lambda x: pm.Gamma.dist(x, 1.0),
        lambda x: pm.Exponential.dist(scale=x),
        lambda x: pm.Laplace.dist(0.0, x),
        lambda x: pm.Uniform.dist(0.0, x),
        lambda x: pm.Categorical.dist(pt.stack([x, 1.0 - x])),
        lambda x: pm.Multinomial.dist(3, pt.stack([x, 1.0 - x]))[0],
        lambda x: pm.StudentT.dist(nu=3.0, mu=0.0, sigma=x),
        lambda x: psf.compartments.euler_multinomial(5, [x], 0.1)[0],
        lambda x: psf.compartments.euler_multinomial(5, [x, 2.0], 0.1)[1] + x,
    ]
    compiled = compile_system(system_of(*distributions))
    X = np.full((30, 1), -1.0)
    c = compiled.prepare.function(np.zeros(0))
    compiled.propagate.function(c, np.zeros((1, 0)), 0, 0.0, np.zeros((compiled.m, 1)), X)
    assert np.isnan(X[: len(distributions)]).all(), X


def test_a_bad_parameter_of_what_is_only_compared_is_a_failure():
    """A comparison with NaN is false: the step would be that of the other category."""

    def system(initial_dist):
        return psf.StateSpaceModel(
            transition=lambda x, q: [x[0] + pt.switch(pt.eq(q[0], 1), 1.0, -1.0)],
            process_dist=lambda x, p: [pm.Bernoulli.dist(p)],
            observation=lambda x: x[0],
            observation_noise=1.0,
            initial_dist=initial_dist,
        )

    compiled = compile_system(system(lambda p: [pt.switch(pt.eq(pm.Bernoulli.dist(p), 1), 1, 0)]))
    for theta, fails in ((0.5, False), (1.5, True)):
        c, X = compiled.prepare.function(np.array([theta])), np.zeros((1, 3))
        compiled.propagate.function(c, np.zeros((1, 0)), 0, 0.0, np.zeros((1, 3)), X)
        assert np.isnan(X).all() == fails
        compiled.initialise.function(c, np.zeros((1, 3)), X)
        assert np.isnan(X).all() == fails


def test_draws_may_be_summed_and_multiplied():
    """Counts are whole numbers, whose sums PyTensor accumulates as such."""
    by_sum = system_of(lambda x: pt.sum(pm.Poisson.dist(x, shape=(2, 3)), axis=0))
    assert by_sum.m == 6
    found = one_step(by_sum, 0.7, 20_000)
    np.testing.assert_array_equal(found, np.round(found))
    assert abs(found.mean() - 1.4) < 5 * np.sqrt(1.4 / 20_000)
    product = system_of(lambda x: pt.prod(pm.Bernoulli.dist(x, shape=2)))
    assert abs(one_step(product, 0.7, 20_000).mean() - 0.49) < 5 * 0.5 / np.sqrt(20_000)


@pytest.mark.parametrize("cast", [lambda k: k, lambda k: pt.cast(k, "int32")])
def test_a_draw_may_be_an_index(cast):
    """Of a number in a table, and of a row."""
    scale, rows = pt.constant([0.1, 10.0]), pt.constant([[0.0, 0.0], [0.0, 1000.0]])

    def chosen(x):
        k = cast(pm.Categorical.dist([0.3, 0.7]))
        return pm.Normal.dist(0, scale[k]) + rows[k][1]

    found = one_step(system_of(chosen), 0.7, 4000)
    first, second = found[found < 500], found[found >= 500] - 1000
    assert stats.binomtest(len(first), len(found), 0.3).pvalue > LEAST_P
    for drawn, sd in ((first, 0.1), (second, 10.0)):
        assert stats.kstest(drawn / sd, "norm").pvalue > LEAST_P


def test_a_bad_parameter_fails_in_a_counted_way():
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0]],
        process_dist=lambda x, rate: [pm.Poisson.dist(rate)],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_dist=lambda: [2],
    )
    with pytest.warns(
        psf.errors.FilterWarning, match="in 1 of 2 evaluations.* overflowed .* In process_dist"
    ):
        terms = psf.log_likelihood(
            system, psf.BootstrapPF(20), {"rate": [1.0, -1.0]}, [2.0, 4.0], steps=[1, 2]
        )
    assert np.isfinite(terms[0]).all()
    assert (terms[1] == -np.inf).all()


@pytest.mark.parametrize(
    ("distribution", "message"),
    [
        (lambda x: pm.Poisson.dist(-1.0), "mu of Poisson must be at least 0, got -1"),
        (
            lambda x: pm.Binomial.dist(3, 1.5),
            "p of Binomial must be between 0 and 1, got 1.5",
        ),
        (lambda x: pm.Binomial.dist(-2, 0.5), "n of Binomial must be a whole number of at least"),
        (lambda x: pm.Gamma.dist(0.0, x), "alpha of Gamma must be above 0, got 0"),
        (lambda x: pm.Wald.dist(1.0, x), "cannot draw Wald .* knows Bernoulli, Beta,"),
        (lambda x: pm.ZeroInflatedPoisson.dist(0.5, x), r"is pm.Bernoulli.dist\(p\) \*"),
        (
            lambda x: pm.MvNormal.dist(np.zeros((2, 2)), np.eye(2), shape=(2, 2)).sum(axis=0),
            r"must draw one vector by each MvNormal, got shape \(2, 2\)",
        ),
        (
            lambda x: pm.Multinomial.dist(5, [0.5, 0.5], shape=(3, 2)).sum(axis=0),
            r"must draw one vector by each Multinomial, got shape \(3, 2\)",
        ),
        (
            lambda x: pt.eye(2)[pt.stack([pm.Bernoulli.dist(x), 0])][0, 0],
            "or a truth value, write pt.switch",
        ),
        (lambda x: pm.Normal.dist(x, 1, shape=(2, 2)), "scalar or vector distributions"),
        (lambda x: None, "got None"),
        (lambda x: "a", "must return symbols or numbers, got 'a'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(distribution, message):
    with pytest.raises(psf.errors.ModelError, match=f"process_dist.*{message}"):
        system_of(distribution)


def test_random_variables_from_outside_are_refused():
    outside = pm.Gamma.dist(2.0, 1.0, name="outside")
    with pytest.raises(
        psf.errors.ModelError, match=r"process_dist must use its arguments .* outside"
    ):
        system_of(lambda x: pm.Poisson.dist(outside))


SYSTEM = {
    "transition": lambda x, q: [x[0] + q[0]],
    "process_dist": lambda x: [pm.Poisson.dist(x[0])],
    "observation": lambda x: [x[0]],
    "observation_noise": [[1.0]],
    "initial_dist": lambda: [pm.Poisson.dist(3.0)],
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"process_noise": [[1.0]]}, "give process_noise or process_dist, got both; Gaussian"),
        (
            {"transition": psf.EulerMaruyama(lambda x: -x, 1.0, dt=0.1)},
            "process_dist must be None beside an integrator.*write the step as a function",
        ),
        ({"transition": lambda x: x}, "process_dist must be None where transition does not have"),
        ({"process_dist": lambda x: []}, "process_dist must return at least one distribution"),
        ({"process_dist": 3}, "process_dist must be a function, got 3"),
        ({"process_dist": lambda x, e: [e]}, "process_dist"),
        (
            {"transition": lambda x, q: [x[0] + q[1]]},
            r"must index q from 0 to 0, got the index 1",
        ),
        ({"initial_mean": [1.0]}, "initial_dist must be given without initial_mean, got both"),
        ({"initial_dist": None}, "initial_mean and initial_cov, or initial_dist.*got none"),
        ({"initial_dist": None, "initial_cov": [[1.0]]}, "got initial_cov alone"),
        ({"initial_dist": lambda: []}, "initial_dist must return at least one distribution"),
        ({"initial_dist": lambda x: [x[0]]}, "initial_dist"),
        ({"initial_dist": lambda: [pm.Poisson.dist(-3.0)]}, "initial_dist: mu of Poisson must be"),
    ],
)
def test_a_wrong_combination_is_refused(changes, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.StateSpaceModel(**SYSTEM | changes)


def test_equal_equations_make_equal_systems():
    def make(scale=1.0):
        return psf.StateSpaceModel(
            **SYSTEM | {"process_dist": lambda x: [pm.Poisson.dist(scale * x[0])]}
        )

    assert make() == make()
    assert make().fingerprint == make().fingerprint
    assert make() != make(2.0)
    assert make().fingerprint != make(2.0).fingerprint
    starts = psf.StateSpaceModel(**SYSTEM | {"initial_dist": lambda: [pm.Poisson.dist(4.0)]})
    assert starts != psf.StateSpaceModel(**SYSTEM)
    again = pickle.loads(pickle.dumps(make()))
    assert again == make()
    assert again.fingerprint == make().fingerprint
    assert again.gaussian == make().gaussian


def test_normal_distributions_are_gaussian_noise():
    """Every filter takes them, and the Kalman filter is exact."""
    by_dist = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0]],
        process_dist=lambda s: [pm.Normal.dist(0.0, s)],
        observation=lambda x: [x[0]],
        observation_noise=[[0.3]],
        initial_dist=lambda m: [pm.Normal.dist(m, 2.0)],
    )
    by_noise = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0]],
        process_noise=lambda s: [[s**2]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.3]],
        initial_mean=lambda m: [m],
        initial_cov=[[4.0]],
    )
    assert by_dist.gaussian is by_dist
    record = {"observed": [0.2, 1.3, -0.4], "steps": [0, 1, 3]}
    params = {"s": 0.5, "m": 1.0}
    exact = psf.log_likelihood(by_noise, psf.EKF(), params, **record)
    for filter in (psf.EKF(), psf.GridFilter(), psf.GuidedPF(5)):
        found = psf.log_likelihood(by_dist, filter, params, **record).sum()
        assert found == pytest.approx(exact.sum(), abs=1e-7)


def test_a_start_that_is_drawn_has_its_law():
    """Numbers, parameters, and distributions that depend on each other."""

    def initial_dist(n):
        infected = pm.Binomial.dist(50, 0.2)
        return [50.0 - infected, infected, n, pm.NegativeBinomial.dist(mu=4.0, alpha=2.0)]

    system = psf.StateSpaceModel(
        transition=lambda x: x,
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_dist=initial_dist,
    )
    compiled = compile_system(system)
    assert (system.n, compiled.n_start) == (4, 3)
    X, theta = np.zeros((4, N_DRAWS)), np.array([7.0])
    Z = np.random.default_rng(3).normal(size=(3, N_DRAWS))
    compiled.initialise.function(compiled.prepare.function(theta), Z, X)
    check_frequencies(np.clip(X[1], 1, 20), np.arange(1, 21), stats.binom(50, 0.2))
    np.testing.assert_array_equal(X[0] + X[1], 50.0)
    np.testing.assert_array_equal(X[2], 7.0)
    counts = stats.nbinom(2.0, 2.0 / 6.0)
    check_frequencies(np.clip(X[3], 0, 25), np.arange(26), counts)
    # Gaussian filters have its mean and covariance.
    run = psf.run_filter(system, psf.EKF(), {"n": 7.0}, [np.nan], steps=[0])
    np.testing.assert_allclose(run["mean"].values[0], [40.0, 10.0, 7.0, 4.0])
    expected = np.zeros((4, 4))
    expected[:2, :2] = [[8.0, -8.0], [-8.0, 8.0]]
    expected[3, 3] = counts.var()
    np.testing.assert_allclose(run["cov"].values[0], expected, atol=1e-12)
