"""Filters of systems that switch between regimes, against the enumeration of all paths of these."""

import pickle
import warnings

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
import xarray as xr
from numba import njit
from pytensor.graph.traversal import ancestors
from scipy.stats import multivariate_normal

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.symbols import symbols_of
from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.filters.ensemble.part_moments import _row_of_cov, draw_of_mixture
from pymc_statespace_filters.filters.ensemble.summaries import n_distinct
from pymc_statespace_filters.filters.regimes.draws import draws_of
from pymc_statespace_filters.filters.regimes.hybrid import hybrid_of
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.distributed import DistributedLogLikelihood
from pymc_statespace_filters.ops.likelihood import LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.ops.states import States
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.modes import AS_IT_STANDS
from tests.ranks import on_ranks
from tests.references.regimes import SwitchingSystem

pytestmark = pytest.mark.usefixtures("interpreted")

FACTOR, SHIFT, SD, SENSOR = (0.9, 0.5), (0.0, 1.5), (0.3, 0.8), 0.4
STAY = (0.7, 0.8)
PARAMS = {"stay_0": STAY[0], "stay_1": STAY[1]}
STEPS = np.array([0, 1, 3, 4, 5, 7, 8])
INPUTS = np.array([0.1, -0.3, 0.0, 0.2, 0.5, -0.1, 0.4, 0.0])[:, None]
RECORD = {"steps": STEPS, "inputs": INPUTS}


def of(values, regime):
    return pt.switch(regime > 0.5, values[1], values[0])


def noise(x, stay_0=STAY[0], stay_1=STAY[1]):
    regime = pm.Bernoulli.dist(pt.switch(x[1] > 0.5, stay_1, 1.0 - stay_0))
    return [regime, pm.Normal.dist(0.0, of(SD, regime))]


def switching(**changes):
    """One state whose equation depends on the regime that a step leads to."""
    settings = {
        "transition": lambda x, q, u: [
            of(FACTOR, q[0]) * x[0] + of(SHIFT, q[0]) + u[0] + q[1], q[0]
        ],
        "process_dist": noise,
        "observation": lambda x: [x[0]],
        "observation_noise": [[SENSOR**2]],
        "initial_dist": lambda: [pm.Normal.dist(0.0, 1.0), pm.Bernoulli.dist(0.5)],
        "states": ["level", "regime"],
        "inputs": ["push"],
        "carried": ["regime"],
    }  # fmt: skip
    return psf.StateSpaceModel(**settings | changes)


SYSTEM = switching()
EXACT = SwitchingSystem(
    P=np.array([[STAY[0], 1 - STAY[0]], [1 - STAY[1], STAY[1]]]),
    A=np.array(FACTOR)[:, None, None],
    b=np.array(SHIFT)[:, None],
    Q=np.square(SD)[:, None, None],
    H=np.eye(1),
    R=np.array([[SENSOR**2]]),
    start=np.array([0.5, 0.5]),
    mean=np.zeros(1),
    cov=np.eye(1),
)
# Simulated, and a row missing.
OBSERVED = np.array([0.4908, 0.1974, 1.4435, np.nan, 2.7747, 2.5502, 3.0971])[:, None]


def log_likelihood(filter, system=SYSTEM, params=PARAMS, observed=OBSERVED, **others):
    with warnings.catch_warnings():  # of few particles, which leave the mean as it is
        warnings.simplefilter("ignore", FilterWarning)
        return psf.log_likelihood(system, filter, params, observed, **RECORD | others).sum(axis=-1)


def exact_log_likelihood(observed=OBSERVED):
    return EXACT.log_likelihood(STEPS, observed, INPUTS)


def check_mean_likelihood(filter, exact, n_seeds, **others):
    """One correct test in 370 fails for another choice of the seeds, which are fixed."""
    estimates = log_likelihood(filter, seed=np.arange(n_seeds), **others)
    ratios = np.exp(estimates - exact)
    error = ratios.std() / np.sqrt(n_seeds)
    assert error < 0.02, error
    assert abs(ratios.mean() - 1.0) < 3.0 * error, (ratios.mean(), error)
    return ratios


@pytest.mark.parametrize(
    ("n_particles", "resampling"), [(2, "sorted"), (4, "multinomial"), (8, "systematic")]
)
def test_the_mean_likelihood_of_particles_is_exact(n_particles, resampling):
    filter = psf.RBPF(n_particles, resampling=resampling, resample_below=0.9)
    ratios = check_mean_likelihood(filter, exact_log_likelihood(), 4000)
    assert ratios.std() > 0.05  # it is an estimate


def test_the_mean_likelihood_of_particles_is_exact_where_the_sensor_switches():
    """As IMM is at the first observation: Gaussians that it has merged were the same."""
    system = switching(observation=lambda x: [x[0] + 1.5 * x[1]])
    record = {"steps": np.array([1]), "observed": np.array([[1.9]])}
    exact = log_likelihood(psf.IMM(), system, **record)
    check_mean_likelihood(psf.RBPF(4), exact, 4000, system=system, **record)


def test_merged_regimes_are_nearly_exact():
    """Two steps between observations leave 0.12 nats, as there are four paths and two Gaussians."""
    error = log_likelihood(psf.IMM()) - exact_log_likelihood()
    assert abs(error) == pytest.approx(0.123, abs=1e-3)
    for inner in (psf.UKF(), psf.IPLF()):
        assert log_likelihood(psf.IMM(inner=inner)) == pytest.approx(
            log_likelihood(psf.IMM()), abs=1e-9
        )


def test_two_observations_are_exact():
    """Nothing is merged before the second: regimes of the start are told apart by it."""
    steps, observed = STEPS[:2], OBSERVED[:2]
    found = psf.log_likelihood(SYSTEM, psf.IMM(), PARAMS, observed, steps=steps, inputs=INPUTS)
    exact = [EXACT.log_likelihood(steps[:n], observed[:n], INPUTS) for n in (1, 2)]
    assert found.cumsum() == pytest.approx(exact, abs=1e-12)


def test_one_regime_is_a_kalman_filter():
    system = switching(
        process_dist=lambda x: [pm.Bernoulli.dist(1.0), pm.Normal.dist(0.0, SD[1])],
        initial_dist=lambda: [pm.Normal.dist(0.0, 1.0), 1.0],
    )
    steps = STEPS
    exact = kalman_log_likelihood(
        [[FACTOR[1]]], [[SD[1] ** 2]], [[1.0]], [[SENSOR**2]], [0.0], [[1.0]], steps=steps,
        observed=OBSERVED, forcing=SHIFT[1] + INPUTS,
    )  # fmt: skip
    for filter in (psf.IMM(), psf.RBPF(2)):
        terms = psf.log_likelihood(system, filter, {}, OBSERVED, **RECORD)
        assert terms == pytest.approx(exact, abs=1e-12)
        assert filter.is_exact_for(compile_system(system))


def test_a_step_may_depend_on_the_regime_that_it_leaves():
    system = switching(
        transition=lambda x, q, u: [of(FACTOR, x[1]) * x[0] + of(SHIFT, x[1]) + u[0] + q[1], q[0]],
        process_dist=lambda x, stay_0, stay_1: [
            pm.Bernoulli.dist(pt.switch(x[1] > 0.5, stay_1, 1.0 - stay_0)),
            pm.Normal.dist(0.0, of(SD, x[1])),
        ],
    )
    exact = _leaving_log_likelihood(EXACT)
    assert log_likelihood(psf.IMM(), system) == pytest.approx(exact, abs=0.2)
    check_mean_likelihood(psf.RBPF(8), exact, 4000, system=system)


def _leaving_log_likelihood(system):
    """By enumeration, of steps that depend on the regime before them."""
    paths, k = [(np.log(p), r, system.mean, system.cov) for r, p in enumerate(system.start)], 0
    for step, d in zip(STEPS, OBSERVED, strict=True):
        while k < step:
            moved = []
            for log_p, r, mean, cov in paths:
                mean, cov = system.A[r] @ mean + system.b[r] + INPUTS[k], system.A[r] ** 2 * cov
                for new in (0, 1):
                    log_new = log_p + np.log(system.P[r, new])
                    moved.append((log_new, new, mean, cov + system.Q[r]))
            paths, k = moved, k + 1
        paths = [
            (found[0], r, *found[2:])
            for log_p, r, mean, cov in paths
            for found in [system._conditioned(log_p, (r,), mean, cov, d)]
        ]
    return np.logaddexp.reduce([path[0] for path in paths])


def test_values_of_the_filtered_state():
    weights, mean, cov = EXACT.last_moments(STEPS, OBSERVED, INPUTS)
    sd = [np.sqrt(cov[0, 0]), np.sqrt(weights[1] * weights[0])]
    for filter, tolerance in ((psf.IMM(), 0.02), (psf.RBPF(20_000), 0.01)):
        run = psf.run_filter(SYSTEM, filter, PARAMS, OBSERVED, **RECORD)
        last = run.isel(time=-1)
        assert last["mean"].values == pytest.approx([mean[0], weights[1]], abs=tolerance)
        assert last["sd"].values == pytest.approx(sd, abs=tolerance)


# Three regimes, each with a start of its own, of two other states that depend on time, and a sensor
# with an input and time.
TURNS = np.array([[0.6, 0.3, 0.1], [0.2, 0.5, 0.3], [0.25, 0.25, 0.5]])
SPEED, LEVEL, SPREAD = (0.9, 0.4, -0.5), (0.0, 1.0, -1.0), (0.3, 0.6, 0.2)
T0, PUSHED = 0.4, np.array([[0.5], [-0.8], [0.3], [1.1]])


def by_regime(values, regime):
    return pt.switch(regime < 0.5, values[0], pt.switch(regime < 1.5, values[1], values[2]))


def turn(x):
    p = pt.stack([by_regime(column, x[2]) for column in TURNS.T.tolist()])
    regime = pm.Categorical.dist(p)
    return [regime, pm.Normal.dist(0.0, by_regime(SPREAD, regime)), pm.Normal.dist(0.0, 0.2)]


def start_of_turns():
    regime = pm.Categorical.dist([0.5, 0.3, 0.2])
    return [
        pm.Normal.dist(by_regime(LEVEL, regime), 1.3),
        pm.Normal.dist(0.2, by_regime(SPREAD, regime)),
        regime,
    ]


TURNING = psf.StateSpaceModel(
    transition=lambda x, q, t: [
        0.8 * x[0] + 0.4 * x[1] + by_regime(LEVEL, q[0]) + 0.1 * t + q[1],
        -0.3 * x[0] + by_regime(SPEED, q[0]) * x[1] + q[2],
        q[0],
    ],
    process_dist=turn,
    observation=lambda x, u, t: [x[0] + 0.5 * x[1] + 0.7 * u[0] + 0.2 * t],
    observation_noise=[[0.2]],
    initial_dist=start_of_turns,
    inputs=["push"],
    dt=0.5,
)
EXACT_TURNS = SwitchingSystem(
    P=TURNS,
    A=np.array([[[0.8, 0.4], [-0.3, speed]] for speed in SPEED]),
    b=np.column_stack([LEVEL, np.zeros(3)]),
    Q=np.array([np.diag([spread**2, 0.04]) for spread in SPREAD]),
    H=np.array([[1.0, 0.5]]),
    R=np.array([[0.2]]),
    start=np.array([0.5, 0.3, 0.2]),
    mean=np.column_stack([LEVEL, np.full(3, 0.2)]),
    cov=np.array([np.diag([1.69, spread**2]) for spread in SPREAD]),
)
SEEN = np.array([0.9, 1.3, 0.4])
TURN_STEPS = np.array([0, 1, 3])


def exact_turns(n, seen=SEEN):
    """Arguments of the reference: the first rows without what is known of them."""
    t = T0 + 0.5 * np.arange(4)
    known = 0.7 * PUSHED[TURN_STEPS, 0] + 0.2 * t[TURN_STEPS]
    return TURN_STEPS[:n], (seen - known)[:n], np.column_stack([0.1 * t, np.zeros(4)])


def moments_of_turns(n, seen=SEEN):
    """Mean and covariance of the whole state at the last of some rows."""
    steps, seen, inputs = exact_turns(n, seen)
    paths = EXACT_TURNS.paths(steps, seen, inputs)
    log_p = np.array([path[0] for path in paths])
    w = np.exp(log_p - np.logaddexp.reduce(log_p))
    means = np.array([[*path[2], path[1][-1]] for path in paths])
    within = np.pad(sum(p * path[3] for p, path in zip(w, paths, strict=True)), (0, 1))
    return w @ means, within + np.cov(means.T, aweights=w, bias=True)


def states_of_turns(filter, moment, n, seeds):
    """Means, standard deviations and draws at the steps of the first rows, of many seeds."""
    run = evaluator(States(TURNING, filter, moment))
    record, wanted = [np.zeros(0), TURN_STEPS[:n], SEEN[:n, None], PUSHED, T0], TURN_STEPS[:n]
    found = [run(*record, seed, wanted, seed) for seed in seeds]
    return [np.array([one[i] for one in found]) for i in range(3)]


def test_regimes_with_starts_times_and_inputs():
    """Exact until the Gaussians of the start, one for each regime, are merged before a step.

    Their mean and covariance stay right, so that those predicted for the second row are exact. Of
    2000 draws covariances are within seven standard errors, those of different steps among them.
    """
    record = {"steps": TURN_STEPS[:2], "inputs": PUSHED, "t0": T0}
    terms = psf.log_likelihood(TURNING, psf.IMM(), {}, SEEN[:2], **record)
    first, second = (EXACT_TURNS.log_likelihood(*exact_turns(n)) for n in (1, 2))
    assert terms[0] == pytest.approx(first, abs=1e-10)
    assert terms.sum() == pytest.approx(second, abs=2e-3)
    nothing = np.full(3, np.nan)
    known = {"predicted": (nothing, np.array([SEEN[0], np.nan, 0])), "filtered": (SEEN, SEEN)}
    for row, (moment, data) in enumerate(reversed(known.items())):
        means, sds, draws = states_of_turns(psf.IMM(), moment, 2, range(2000))
        mean, cov = moments_of_turns(row + 1, data[row])
        np.testing.assert_allclose(means[0, row], mean, atol=1e-10)
        np.testing.assert_allclose(sds[0, row], np.sqrt(np.diag(cov)), atol=1e-10)
        exact = np.zeros((6, 6))
        for row in (0, 1):
            exact[3 * row :][:3, 3 * row :][:, :3] = moments_of_turns(row + 1, data[row])[1]
        sd = np.sqrt(np.diag(exact))
        error = np.cov(draws.reshape(2000, 6).T) - exact
        assert (abs(error) < 7 * np.outer(sd, sd) / 2000**0.5).all()


def test_particles_of_regimes_with_starts_times_and_inputs():
    """The mean likelihood: one correct test in 370 fails for other seeds. And predicted states."""
    exact = EXACT_TURNS.log_likelihood(*exact_turns(3))
    record = {"steps": TURN_STEPS, "inputs": PUSHED, "t0": T0, "seed": np.arange(3000)}
    ratios = np.exp(log_likelihood(psf.RBPF(8), TURNING, {}, SEEN, **record) - exact)
    error = ratios.std() / 3000**0.5
    assert abs(ratios.mean() - 1) < 3 * error < 0.06
    means, _, draws = states_of_turns(psf.RBPF(200), "predicted", 3, range(400))
    mean, cov = moments_of_turns(3, np.array([*SEEN[:2], np.nan]))
    sd = np.sqrt(np.diag(cov))
    assert (abs(means[:, 2].mean(axis=0) - mean) < 0.03 * sd).all()
    assert (abs(draws[:, 2].mean(axis=0) - mean) < 4 * sd / 20).all()


def test_a_drifting_parameter_varies_within_particles():
    """Each particle has a normal law of it, nearly as wide as the whole one."""
    system = psf.drifting(
        switching(
            transition=lambda x, q, u, trend: [
                of(FACTOR, q[0]) * x[0] + of(SHIFT, q[0]) + u[0] + trend + q[1], q[0]
            ]
        ),
        trend=psf.RandomWalk(),
    )  # fmt: skip
    params, filter = PARAMS | {"trend": 0.2, "trend_strength": 0.3}, psf.RBPF(500)
    run = psf.run_filter(system, filter, params, OBSERVED, seed=1, **RECORD)
    left = run["filter_state"].values[np.newaxis]
    _, (cov,) = filter.law_of_state(compile_system(system), left).moments()
    np.testing.assert_allclose(run["cov"].values[-1], cov, atol=0.01)
    assert cov[2, 2] > 0.1
    row = psf.online(system, filter, params, random_seed=1).update(0.5, step=4, inputs=INPUTS[:4])
    assert row.cov[2, 2] > 0.1


def test_variances_between_few_particles_are_unbiased():
    """Over 1 - sum w^2: of the regime all variance is between particles."""
    run = psf.run_filter(SYSTEM, psf.RBPF(8), PARAMS, OBSERVED, **RECORD, seed=1)
    w, regimes = run["weights"].values, run["particles"].sel(state="regime").values
    mean = (w * regimes).sum(axis=1)
    variance = (w * (regimes - mean[:, None]) ** 2).sum(axis=1) / (1 - (w**2).sum(axis=1))
    np.testing.assert_allclose(run["sd"].sel(state="regime"), np.sqrt(variance), atol=1e-12)


def test_covariances_of_a_part_are_the_rows_of_a_lower_triangle():
    """Behind two finite states and three means."""

    @njit
    def row(i, j):
        return _row_of_cov(5, 2, 2 + i, 2 + j)

    pairs = list(zip(*np.tril_indices(3), strict=True))
    assert [row(i, j) for i, j in pairs] == [row(j, i) for i, j in pairs] == [5, 6, 7, 8, 9, 10]
    assert row(-1, 1) == -1


def test_normal_states_of_a_draw_are_independent():
    """So are their squares, whose correlation has an error of 0.01."""

    @njit
    def drawn(X, order, n):
        out = np.empty((n, order.size))
        for seed in range(n):
            draw_of_mixture(np.ones(1), X, 1, order, seed, 0, out[seed])
        return out

    X = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 1.0]]).T  # a regime, means, lower triangle
    squares = drawn(X, np.array([1, 2, 0]), 10_000)[:, :2] ** 2
    assert abs(np.corrcoef(squares.T)[0, 1]) < 0.04


def row_of_ring(regime, p):
    """Probabilities of the regimes after one of three, of which one is never next."""
    p = pt.as_tensor(p)
    rows = [pt.stack([1 - p, p, 0.0]), pt.stack([0.0, 1 - p, p]), pt.stack([p, 0.0, 1 - p])]
    return pt.switch(pt.eq(regime, 0), rows[0], pt.switch(pt.eq(regime, 1), rows[1], rows[2]))


RING = switching(
    transition=lambda x, q, u: [0.5 * x[0] + q[0] + u[0] + q[1], q[0]],
    process_dist=lambda x, p: [
        pm.Categorical.dist(row_of_ring(x[1], p)), pm.Normal.dist(0.0, 0.3 + 0.2 * x[1])
    ],
    initial_dist=lambda: [pm.Normal.dist(0.0, 1.0), 0.0],
)  # fmt: skip


def test_the_gradient_is_that_of_the_value():
    """Also of moves that never happen."""
    with pm.Model() as model:
        p = pm.Uniform("p")
        psf.StateSpace("d", RING, psf.IMM(), observed=OBSERVED, **RECORD)
        value = model.compile_logp(jacobian=False)
        (slope,) = model.compile_dlogp([p], jacobian=False)({"p_interval__": -0.4})
    above, below = (value({"p_interval__": -0.4 + step}) for step in (1e-5, -1e-5))
    assert slope == pytest.approx((above - below) / 2e-5, rel=1e-7, abs=1e-8)


def test_probabilities_that_depend_on_the_state():
    """A level above one is likely to switch: no filter of regimes is exact, both are near.

    With probabilities at the mean of the level both would be 0.2 nats off.
    """
    system = switching(
        process_dist=lambda x: [
            pm.Bernoulli.dist(pm.math.sigmoid(3.0 * (x[0] - 1.0))), pm.Normal.dist(0.0, 0.3)
        ]
    )  # fmt: skip
    compiled = compile_system(system)
    assert not psf.RBPF(10).is_exact_for(compiled)
    assert not psf.IMM().is_exact_for(compiled)
    plain = log_likelihood(psf.BootstrapPF(20_000), system, {}, seed=np.arange(10)).mean()
    assert log_likelihood(psf.IMM(), system, {}) == pytest.approx(plain, abs=0.05)
    assert log_likelihood(psf.RBPF(5000), system, {}) == pytest.approx(plain, abs=0.05)


def logistic(a, b):
    return 1.0 / (1.0 + np.exp(-3.0 * (a - b - 0.3)))


# The probability of a regime, by states and on a grid of them, and the error of its mean.
OF_STATES = {
    "even": (lambda x: 1 - pt.exp(-(x[0] ** 2)), lambda a, b: 1 - np.exp(-(a**2)), 5e-4),
    "jump": (lambda x: pt.switch(x[0] > 0, 0.9, 0.1), lambda a, b: 0.1 + 0.8 * (a > 0), 2e-3),
    "line": (lambda x: pm.math.sigmoid(3 * (x[0] - x[1] - 0.3)), logistic, 3e-3),
    "round": (
        lambda x: 1 - pt.exp(-(x[0] ** 2) - x[1] ** 2),
        lambda a, b: 1 - np.exp(-(a**2) - b**2),
        0.04,
    ),
}


@pytest.mark.parametrize("kind", OF_STATES)
def test_means_of_probabilities_are_those_of_a_grid(kind):
    """From the mean, where slopes of most are zero; the state given the regime, too."""
    probability, on_grid, tolerance = OF_STATES[kind]
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0], x[1], q[0]],
        process_dist=lambda x: [pm.Bernoulli.dist(probability(x))],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_dist=lambda: [pm.Normal.dist(0, 1), pm.Normal.dist(0, 1), 0],
    )
    hybrid, s = hybrid_of(system), pt.tensor("s", shape=(5,), dtype="float64")
    values = symbols_of(system)
    drawn = [pt.constant(v) for v in hybrid.drawn]
    outputs = [*draws_of(hybrid, values, pt.zeros(1), s, drawn)[1]]
    outputs += [pytensor.grad(outputs[0], s)] if kind in ("even", "line") else []
    given = pytensor.function([s], outputs, mode=AS_IT_STANDS)
    gaussian = np.array([0.0, 0.0, 1.0, 0.3, 0.8])  # mean, lower triangle of the covariance
    weight, state, *slopes = given(gaussian)
    a, b = np.meshgrid(*[np.linspace(-6, 6, 600)] * 2)
    density = multivariate_normal([0, 0], [[1.0, 0.3], [0.3, 0.8]]).pdf(np.stack([a, b], -1))
    joint = density * on_grid(a, b) / density.sum()
    assert weight == pytest.approx(joint.sum(), abs=tolerance)
    both = np.stack([a.ravel(), b.ravel()])
    mean, cov = (
        np.average(both, axis=1, weights=joint.ravel()),
        np.cov(both, aweights=joint.ravel()),
    )
    np.testing.assert_allclose(state[:2], mean, atol=5 * tolerance if kind != "jump" else 0.03)
    np.testing.assert_allclose(state[2:], cov[np.tril_indices(2)], atol=0.1)
    along = np.array([0.7, -0.4, 0.5, 0.3, -0.6])
    for slope in slopes:
        above, below = (given(gaussian + h * along)[0] for h in (1e-5, -1e-5))
        assert slope @ along == pytest.approx((above - below) / 2e-5, abs=1e-7)


def test_nodes_of_a_quadrature_share_a_graph():
    """Which would grow, and with it the time to compile a gradient, with their number."""

    def size(slope):
        system = switching(
            transition=lambda x, q: [x[0], x[1], q[0]],
            process_dist=lambda x: [pm.Bernoulli.dist(pt.sigmoid(x[0] + slope * x[1]))],
            initial_dist=lambda: [pm.Normal.dist(0, 1), pm.Normal.dist(0, 1), 0],
            states=["level", "trend", "regime"],
            inputs=[],
        )
        hybrid, s = hybrid_of(system), pt.tensor("s", shape=(5,), dtype="float64")
        drawn = [pt.constant(v) for v in hybrid.drawn]
        found = draws_of(hybrid, symbols_of(system), pt.zeros(1), s, drawn)
        return len(list(ancestors([part.state for part in found])))

    assert size(1.0) < 3 * size(0.0)  # 48 nodes, not 12


@pytest.mark.parametrize("filter", [psf.IMM(), psf.RBPF(10)], ids=str)
def test_a_regime_is_entered_from_rest(filter):
    """With probability 1 - E exp(-x^2) = 1 - 3^(-1/2)."""
    system = switching(
        process_dist=lambda x: [
            pm.Bernoulli.dist(1 - pt.exp(-(x[0] ** 2))), pm.Normal.dist(0.0, 0.3)
        ],
        initial_dist=lambda: [pm.Normal.dist(0.0, 1.0), 0],
        observation=lambda x: [x[1]],
        observation_noise=[[1e-4]],
    )  # fmt: skip
    term = psf.log_likelihood(system, filter, {}, [1.0], steps=[1], inputs=[[0.0]])
    exact = np.log(1 - 3**-0.5) - 0.5 * np.log(2 * np.pi * 1e-4)
    np.testing.assert_allclose(term, exact, atol=1e-3)


def test_held_noise_is_the_noise_of_its_seed():
    filter = psf.RBPF(70)
    (stored,) = evaluator(StoredNoise(SYSTEM, filter))(STEPS, 5)
    theta = np.array(list(PARAMS.values()))
    terms, _ = evaluator(LogLikelihoodOfNoise(SYSTEM, filter))(
        theta, STEPS, OBSERVED, INPUTS, 0.0, stored
    )
    of_seed = psf.log_likelihood(SYSTEM, filter, PARAMS, OBSERVED, **RECORD, seed=5)
    assert np.array_equal(terms, of_seed)


def test_particles_over_ranks():
    """All ranks have the same bits, however many there are."""
    evaluate = evaluator(DistributedLogLikelihood(SYSTEM, psf.RBPF(150)))
    given = (np.array(list(PARAMS.values())), STEPS, OBSERVED, INPUTS, 0.0, 5)
    alone = psf.log_likelihood(SYSTEM, psf.RBPF(150), PARAMS, OBSERVED, **RECORD, seed=5)
    for n in (1, 2, 3):
        for terms, _ in on_ranks(
            n, lambda ours: evaluate(*given, ours.rank, ours.size, ours.exchange)
        ):
            assert np.array_equal(terms, alone)


def test_a_filter_goes_on_from_its_state():
    for filter in (psf.IMM(), psf.RBPF(50)):
        whole = psf.run_filter(SYSTEM, filter, PARAMS, OBSERVED, **RECORD, seed=3)
        first = psf.run_filter(
            SYSTEM, filter, PARAMS, OBSERVED[:4], steps=STEPS[:4], inputs=INPUTS, seed=3
        )
        later = psf.run_filter(
            SYSTEM, filter, PARAMS, OBSERVED[4:], steps=STEPS[4:], inputs=INPUTS, seed=3,
            state=first,
        )  # fmt: skip
        terms = [run["log_likelihood"].values for run in (first, later)]
        assert np.concatenate(terms) == pytest.approx(whole["log_likelihood"].values, abs=1e-12)


REFUSED = [
    (dict(process_dist=lambda x: [pm.Normal.dist(0, 1), pm.Normal.dist(0, 1)]), "needs a regime"),
    (
        dict(process_dist=lambda x: [pm.Bernoulli.dist(0.5), pm.Laplace.dist(0, 1)]),
        "needs normal noise beside",
    ),
    (
        dict(
            transition=lambda x, q: [q[0], q[1]],
            process_dist=lambda x: [pm.Bernoulli.dist(0.5), pm.Bernoulli.dist(0.5)],
            initial_dist=lambda: [0.0, 0.0],
            inputs=(),
        ),
        "continuous states beside the regime",
    ),
    (
        dict(initial_dist=lambda: [pm.Gamma.dist(2, 1), pm.Bernoulli.dist(0.5)]),
        "another distribution in process_dist or initial_dist",
    ),
    (
        dict(process_dist=lambda x: [pm.DiscreteUniform.dist(0, 9), pm.Normal.dist(0, 1)]),
        "at most 64 transitions between regimes, this system has 100",
    ),
]


@pytest.mark.parametrize(
    ("changes", "message"), REFUSED, ids=lambda v: v if isinstance(v, str) else ""
)
@pytest.mark.parametrize("filter", [psf.IMM(), psf.RBPF(10)], ids=str)
def test_systems_that_are_refused(filter, changes, message):
    system = switching(**changes)
    with pytest.raises(ModelError, match=message):
        psf.log_likelihood(system, filter, {}, OBSERVED, **RECORD)


def test_probabilities_that_do_not_sum_to_one_are_a_failure():
    bad = {"stay_0": 1.2, "stay_1": 0.5}
    for filter in (psf.IMM(), psf.RBPF(10)):
        with pytest.warns(FilterWarning):
            terms = psf.log_likelihood(SYSTEM, filter, bad, OBSERVED, **RECORD)
        assert np.isneginf(terms[1:]).any()


@pytest.mark.parametrize("inner", [psf.BootstrapPF(10), psf.IMM(), psf.EKF, None], ids=str)
def test_other_filters_inside(inner):
    for make in (psf.IMM, lambda inner: psf.RBPF(10, inner=inner)):
        with pytest.raises(ModelError, match=r"inner must be psf.EKF\(\), psf.UKF\(\) or"):
            make(inner=inner)


def test_settings_are_pickled():
    for filter in (psf.IMM(inner=psf.UKF()), psf.RBPF(10, inner=psf.IPLF())):
        assert pickle.loads(pickle.dumps(filter)) == filter


@pytest.fixture(scope="module")
def draws():
    """Draws of a posterior that is a point."""
    shape = (1, 2000)
    values = {name: (("chain", "draw"), np.full(shape, value)) for name, value in PARAMS.items()}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(values)})


def model_of(filter, system=SYSTEM, **others):
    with pm.Model() as model:
        pm.Uniform("stay_0")
        pm.Uniform("stay_1")
        psf.StateSpace("d", system, filter, **{"observed": OBSERVED, **RECORD, **others})
    return model


@pytest.mark.parametrize("filter", [psf.IMM(), psf.RBPF(500)], ids=str)
def test_drawn_states_are_those_of_the_mixture(filter, draws):
    """Within four standard errors of two thousand draws, and the bias of merged regimes."""
    weights, mean, cov = EXACT.last_moments(STEPS, OBSERVED, INPUTS)
    with model_of(filter):
        found = psf.filtered_states(draws, random_seed=1, progressbar=False)
        inputs = np.zeros((10, 1))
        ahead = psf.forecast(draws, n_steps=2, inputs=inputs, progressbar=False, n_draws=20)
    last = found["filtered_states"]["d_states"].isel(d_time=-1, chain=0).values
    assert set(last[:, 1]) == {0.0, 1.0}
    assert last[:, 1].mean() == pytest.approx(weights[1], abs=0.06)
    assert last[:, 0].mean() == pytest.approx(mean[0], abs=0.04)
    assert last[:, 0].std() == pytest.approx(np.sqrt(cov[0, 0]), rel=0.1)
    assert np.isfinite(ahead["predictions"]["d"].values).all()


FOUR_ERRORS = 4.0 * 0.13 / 10
"""Of the mean of a hundred means of noisy filters, which have deviations up to 0.13."""


@pytest.mark.parametrize(
    ("filter", "tolerance"), [(psf.IMM(), 0.06), (psf.RBPF(100), FOUR_ERRORS)], ids=str
)
def test_smoothed_states_are_those_of_all_paths(filter, tolerance, draws):
    """Those of merged regimes have a bias."""
    with model_of(filter):
        arguments = {"n_draws": 100, "random_seed": 1, "progressbar": False}
        all_steps = psf.smoothed_states(draws, at="steps", **arguments)["smoothed_states"]
        at_data = psf.smoothed_states(draws, **arguments)["smoothed_states"]
    weights, mean, cov = EXACT.smoothed_moments(STEPS, OBSERVED, INPUTS)
    check_smoothed(all_steps, mean, cov, weights[:, 1], tolerance)
    assert all_steps["d_states"].attrs["smoothing"] == "backward simulation"
    for name in at_data.data_vars:
        assert np.array_equal(at_data[name], all_steps[name].isel(d_time=STEPS))


def test_parts_of_the_mixture_that_paths_share_count_once():
    assert n_distinct.py_func(np.array([3, 1, 3, 0, 3]), 5) == 3


def check_smoothed(found, mean, cov, probability, tolerance):
    """Compare states that end with a regime of two values; draws have the errors of a hundred."""
    exact = np.column_stack([mean, probability])
    variances = np.diagonal(cov, axis1=1, axis2=2)
    sd = np.sqrt(np.column_stack([variances, probability * (1 - probability)]))
    means, sds, states = (found[f"d_{name}"][0].values for name in ("mean", "sd", "states"))
    whole_sd = np.sqrt(np.mean(sds**2, axis=0) + means.var(axis=0))
    np.testing.assert_allclose(means.mean(axis=0), exact, atol=tolerance)
    np.testing.assert_allclose(whole_sd, sd, atol=tolerance + 0.01)
    of_draws = tolerance + 4.0 * sd / len(states) ** 0.5
    assert (np.abs(states.mean(axis=0) - exact) <= of_draws).all()
    assert set(np.unique(states[..., -1])) <= {0.0, 1.0}


# A body with noise on the velocity alone, from a known start, whose damping and force switch.
DAMPING, FORCE, PUSH = (0.8, 0.2), (0.0, 0.6), 0.4
BODY = switching(
    transition=lambda x, q: [
        x[0] + 0.5 * x[1],
        of(DAMPING, q[0]) * x[1] - 0.4 * x[0] + of(FORCE, q[0]) + q[1],
        q[0],
    ],
    process_dist=lambda x, stay_0, stay_1: [
        pm.Bernoulli.dist(pt.switch(x[2] > 0.5, stay_1, 1.0 - stay_0)),
        pm.Normal.dist(0, PUSH),
    ],
    observation_noise=[[0.003**2]],
    initial_dist=lambda: [1.0, 0.0, pm.Bernoulli.dist(0.5)],
    states=["position", "velocity", "regime"],
    inputs=(),
)


@pytest.mark.parametrize(
    ("filter", "steps", "tolerance"),
    [
        (psf.IMM(), np.arange(1, 8), 0.06),
        (psf.RBPF(100), np.array([1, 3, 4, 6, 7]), FOUR_ERRORS),
    ],
    ids=["IMM", "RBPF"],
)
def test_smoothed_paths_where_a_state_has_no_noise(filter, steps, tolerance, draws):
    """With a precise sensor; a step of the position is known given the velocity."""
    exact = SwitchingSystem(
        P=EXACT.P,
        A=np.array([[[1.0, 0.5], [-0.4, damping]] for damping in DAMPING]),
        b=np.column_stack([np.zeros(2), FORCE]),
        Q=np.array(2 * [np.diag([0.0, PUSH**2])]),
        H=np.array([[1.0, 0.0]]),
        R=np.array([[0.003**2]]),
        start=EXACT.start,
        mean=np.array([1.0, 0.0]),
        cov=np.zeros((2, 2)),
    )
    observed = psf.simulate(BODY, PARAMS, steps=steps, random_seed=3)["observations"].values
    with model_of(filter, BODY, observed=observed, steps=steps, inputs=None):
        found = psf.smoothed_states(
            draws, at="steps", n_draws=100, random_seed=1, progressbar=False
        )["smoothed_states"]
    weights, mean, cov = exact.smoothed_moments(steps, observed, np.zeros((8, 1)))
    check_smoothed(found, mean, cov, weights[:, 1], tolerance)
    position, velocity, _ = np.moveaxis(found["d_states"][0].values, -1, 0)
    moved = position[:, :-1] + 0.5 * velocity[:, :-1]
    np.testing.assert_allclose(position[:, 1:], moved, atol=1e-5)


def test_a_panel_is_its_records():
    record = {"panel": np.repeat(["a", "b"], len(STEPS)), "steps": np.tile(STEPS, 2)}
    both = {"observed": np.concatenate([OBSERVED, 0.5 * OBSERVED])}
    point = {"stay_0_interval__": 0.8, "stay_1_interval__": -0.3}
    logp = model_of(psf.IMM(), **record, **both).compile_logp()
    single = [model_of(psf.IMM(), observed=d).compile_logp() for d in (OBSERVED, 0.5 * OBSERVED)]
    of_data = model_of(psf.IMM(), observed=OBSERVED)
    prior = of_data.compile_logp(vars=of_data.free_RVs)
    total = sum(f(point) for f in single) - prior(point)
    assert logp(point) == pytest.approx(total, abs=1e-10)
