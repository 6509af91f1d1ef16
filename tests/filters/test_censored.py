"""Censored data against dense grids, enumeration and sums of distribution functions."""

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError

TRUE = {"a": 0.8, "s": 0.6}
NOISE = np.array([0.5, 0.7])
STEP = {"transition": lambda x, q, a, s: [a * x[0] + s * q[0]], "process_noise": [[1.0]]}
START = {"initial_mean": [0.0], "initial_cov": [[1.0]]}
ONE = psf.StateSpaceModel(
    observation=lambda x: [x[0]], observation_noise=[[NOISE[0] ** 2]], **STEP, **START
)
TWO = psf.StateSpaceModel(
    observation=lambda x: [x[0], -2.0 * x[0]],
    observation_noise=np.diag(NOISE**2),
    observables=["direct", "double"],
    **STEP,
    **START,
)
COUNTS = psf.StateSpaceModel(
    observation_dist=lambda x, c=0.5: [pm.Poisson.dist(pt.exp(c + x[0]))], **STEP, **START
)
# Without noise and with a known start
RATE = psf.StateSpaceModel(
    lambda x, a: [a * x[0]],
    observation_dist=lambda x, s: [pm.NegativeBinomial.dist(mu=pt.exp(s * x[0]), alpha=3.0)],
    initial_mean=[3.0],
    initial_cov=[[0.0]],
)
GRID = np.linspace(-9, 9, 2401)
STEPS = np.arange(30) * 2


def log_likelihood(system, filter, y, flags, **others):
    return psf.log_likelihood(system, filter, TRUE, y, steps=STEPS, censored=flags, **others)


@pytest.fixture(scope="module")
def path():
    """A path of the AR(1) process at the steps."""
    rng = np.random.default_rng(3)
    x = [rng.normal()]
    while len(x) <= STEPS[-1]:
        x.append(TRUE["a"] * x[-1] + TRUE["s"] * rng.normal())
    return np.array(x)[STEPS]


@pytest.fixture(scope="module")
def record(path):
    """Two sensors, of which about 30 % lie below a limit, some above another, and some are NaN."""
    rng = np.random.default_rng(4)
    y = np.stack([path, -2.0 * path], axis=1) + NOISE * rng.normal(size=(len(path), 2))
    low, high = np.quantile(y, 0.3, axis=0), np.quantile(y, 0.9, axis=0)
    flags = np.where(y < low, -1, np.where(y > high, 1, 0))
    y = np.clip(y, low, high)
    y[4, 0] = y[7:9, 1] = np.nan
    return y, np.where(np.isnan(y), 0, flags)


@pytest.fixture(scope="module")
def counts(path):
    """Counts, recorded as 1 where at most 1, and as 4 where at least 4."""
    y = np.random.default_rng(5).poisson(np.exp(0.5 + path)).astype(float)
    flags = np.where(y <= 1, -1, np.where(y >= 4, 1, 0))
    return np.clip(y, 1, 4)[:, None], flags[:, None]


def on_grid(densities):
    """Terms of the likelihood by sums over a dense grid, of p(d_j | x) on it."""
    width = GRID[1] - GRID[0]
    move = stats.norm.pdf(GRID[:, None], TRUE["a"] * GRID, TRUE["s"]) * width
    mass, terms, k = stats.norm.pdf(GRID) * width, [], 0
    for step, density in zip(STEPS, densities, strict=True):
        for _ in range(k, step):
            mass = move @ mass
        k, mass = step, mass * density
        terms.append(np.log(mass.sum()))
        mass /= mass.sum()
    return np.array(terms)


def gaussian_densities(y, flags, sensors):
    found = []
    for datum, own in zip(y, flags, strict=True):
        density = np.ones_like(GRID)
        for b, slope in enumerate(sensors):
            z = (datum[b] - slope * GRID) / NOISE[b]
            if not np.isnan(datum[b]):
                density *= stats.norm.cdf(-own[b] * z) if own[b] else stats.norm.pdf(z) / NOISE[b]
        found.append(density)
    return found


@pytest.fixture(scope="module")
def exact(record, counts):
    """Terms by the dense grid, for each system."""
    y, flags = record
    law = stats.poisson(np.exp(0.5 + GRID))
    of_counts = [
        law.cdf(d) if f < 0 else law.sf(d - 1) if f > 0 else law.pmf(d)
        for d, f in zip(counts[0][:, 0], counts[1][:, 0], strict=True)
    ]
    return {
        ONE: on_grid(gaussian_densities(y[:, :1], flags[:, :1], [1.0])),
        TWO: on_grid(gaussian_densities(y, flags, [1.0, -2.0])),
        COUNTS: on_grid(of_counts),
    }


@pytest.fixture(scope="module")
def data(record, counts):
    y, flags = record
    return {ONE: (y[:, :1], flags[:, :1]), TWO: (y, flags), COUNTS: counts}


SYSTEMS = pytest.mark.parametrize("system", [ONE, TWO, COUNTS], ids=["one", "two", "counts"])


@SYSTEMS
def test_the_grid_filter_is_exact(system, data, exact):
    terms = log_likelihood(system, psf.GridFilter(), *data[system])
    np.testing.assert_allclose(terms, exact[system], atol=1e-9)


@SYSTEMS
@pytest.mark.parametrize("filter", [psf.BootstrapPF(500), psf.GuidedPF(60), psf.PFEnKF(500)])
def test_particle_filters_are_unbiased(system, filter, data, exact):
    """A right one fails for one in 16 000 seeds."""
    estimates = log_likelihood(system, filter, *data[system], seed=np.arange(300)).sum(axis=1)
    ratios = np.exp(estimates - exact[system].sum())
    assert abs(ratios.mean() - 1.0) < 4.0 * ratios.std() / np.sqrt(ratios.size)
    assert ratios.std() < 1.5


@pytest.mark.parametrize("system", [ONE, TWO], ids=["one", "two"])
def test_gaussian_filters_are_close_and_one_for_a_linear_sensor(system, data, exact):
    found = [log_likelihood(system, f, *data[system]) for f in (psf.EKF(), psf.UKF(), psf.IPLF())]
    for terms in found:
        assert 1e-4 < abs(terms - exact[system]).max() < 0.1
        assert abs(terms.sum() - exact[system].sum()) < 0.2
        np.testing.assert_allclose(terms, found[0], rtol=1e-12)
        assert not psf.EKF().is_exact_for(compile_system(system.censored))


def test_flags_of_zero_are_no_flags(record):
    y = record[0][:, :1]
    for filter in (psf.EKF(), psf.BootstrapPF(50)):
        found = log_likelihood(ONE, filter, y, np.zeros(y.shape))
        np.testing.assert_array_equal(found, log_likelihood(ONE, filter, y, None))


def test_one_gaussian_update_of_a_start_that_is_known_to_lie_below_is_exact():
    """One state, one value: mean and variance of the state given y < d, by quadrature."""
    system = psf.StateSpaceModel(
        lambda x: [x[0]], lambda x: [x[0]], observation_noise=[[0.25]], **START
    )
    weight = stats.norm.pdf(GRID) * stats.norm.cdf((-0.4 - GRID) / 0.5)
    mean = (GRID * weight).sum() / weight.sum()
    sd = np.sqrt(((GRID - mean) ** 2 * weight).sum() / weight.sum())
    for filter in (psf.EKF(), psf.UKF(), psf.IPLF()):
        run = psf.run_filter(system, filter, {}, [-0.4], steps=[0], censored=[-1])
        np.testing.assert_allclose(run["mean"].item(), mean, rtol=1e-10)
        np.testing.assert_allclose(run["sd"].item(), sd, rtol=1e-10)
        term = stats.norm.logcdf(-0.4, 0.0, 1.25**0.5)
        np.testing.assert_allclose(run["log_likelihood"].item(), term, rtol=1e-12)


FALLING = psf.StateSpaceModel(
    psf.RungeKutta4(lambda x, u, k: [-k * x[0] + u[0]], dt=0.1),
    lambda x: [x[0], x[0] ** 2],
    observation_noise=lambda r: [[r**2, 0], [0, 0.3]],
    initial_mean=lambda x0: [x0],
    initial_cov=[[0.0]],
    inputs=["feed"],
)


def sums_of_distribution_functions(y, flags, x, sd):
    """Terms of independent Gaussian sensors around known values."""
    law = stats.norm(x, sd)
    terms = np.where(flags == 0, law.logpdf(y), np.where(flags < 0, law.logcdf(y), law.logsf(y)))
    return np.nansum(terms, axis=1)


@pytest.mark.parametrize("times", [[0.4, 1.1, 1.8], [0.33, 1.1, 1.777]], ids=["grid", "any"])
def test_a_deterministic_system_has_sums_of_distribution_functions(times):
    """Inputs by step are those of the steps before the last observation alone."""
    theta, y = {"k": 0.7, "x0": 2.0, "r": 0.2}, np.array([[1.2, 2.0], [1.0, np.nan], [0.5, 0.1]])
    flags = np.array([[-1, 0], [1, 0], [0, 1]])
    inputs = {"inputs": np.linspace(0.1, 0.5, 18)}
    if times[0] == 0.33:
        inputs = {"inputs": [0.3, 0.2], "input_times": [0.0, 1.0]}
    known = psf.simulate(FALLING, theta, times=times, noise=False, **inputs)
    terms = psf.log_likelihood(FALLING, psf.EKF(), theta, y, times=times, censored=flags, **inputs)
    expected = sums_of_distribution_functions(y, flags, known["observations"], [0.2, 0.3**0.5])
    np.testing.assert_allclose(terms, expected, atol=1e-10)


def test_flags_have_columns_beside_events_sums_and_drifting_parameters():
    system = psf.StateSpaceModel(
        psf.RungeKutta4(lambda x, k: [-k * x[0], x[0]], dt=0.1),
        lambda x: [x[0], x[1]],
        observation_noise=np.diag([0.04, 0.09]),
        initial_mean=[2.0, 0.0],
        initial_cov=np.zeros((2, 2)),
        states=["level", "sum"],
        accumulators=["sum"],
        event=lambda x, dose: [x[0] + dose, x[1]],
        events=["dose"],
    )
    times, flags = [0.4, 1.1, 1.8], np.array([[-1, 1], [0, -1], [1, 0]])
    given = {"times": times, "events": {"time": [0.4, 1.5], "dose": [1.0, 0.5]}}
    known = psf.simulate(system, {"k": 0.7}, noise=False, **given)
    y = known["observations"].values + np.array([[0.1, -0.2], [0.3, 0.1], [0.1, 0.2]])
    expected = sums_of_distribution_functions(y, flags, known["observations"], [0.2, 0.3])
    terms = psf.log_likelihood(system, psf.EKF(), {"k": 0.7}, y, censored=flags, **given)
    np.testing.assert_allclose(terms, expected, atol=1e-10)
    drifting = psf.drifting(system, k=psf.RandomWalk(scale="log", every=4))
    theta = {"k": 0.7, "k_strength": 1e-9}
    terms = psf.log_likelihood(drifting, psf.EKF(), theta, y, censored=flags, **given)
    np.testing.assert_allclose(terms, expected, atol=1e-6)


REGIMES = psf.StateSpaceModel(
    transition=lambda x, q, a, s: [a * x[0] + q[0] + s * q[1], q[0]],
    process_dist=lambda x: [pm.Bernoulli.dist(0.2 + 0.5 * x[1]), pm.Normal.dist()],
    observation=lambda x: [x[0]],
    observation_noise=[[NOISE[0] ** 2]],
    initial_dist=lambda: [pm.Normal.dist(), 0],
)


def test_a_filter_of_regimes_goes_on_with_truncated_moments(data):
    """Against a dense grid of both states; one observation at every step."""
    y, flags = data[ONE]
    width, jump = GRID[1] - GRID[0], np.array([[0.8, 0.2], [0.3, 0.7]])
    mass = np.stack([stats.norm.pdf(GRID), 0.0 * GRID]) * width
    to = [stats.norm.pdf(GRID[:, None], 0.8 * GRID + r, 0.6) * width for r in (0, 1)]
    exact = 0.0
    densities = gaussian_densities(y[:8], flags[:8], [1.0])
    for k, density in enumerate(densities):
        if k:
            mass = np.stack([to[r] @ (jump[:, r] @ mass) for r in (0, 1)])
        mass = mass * density
        exact += np.log(mass.sum())
        mass = mass / mass.sum()
    given = {"steps": np.arange(8), "censored": flags[:8]}
    found = psf.log_likelihood(REGIMES, psf.IMM(), TRUE, y[:8], **given).sum()
    assert 1e-6 < abs(found - exact) < 0.1
    assert not psf.IMM().is_exact_for(compile_system(REGIMES.censored))


def value_and_gradient(model, point):
    """Log-likelihood of the variable d of a model, and its gradient."""
    function = model.logp_dlogp_function(ravel_inputs=True)
    function.set_extra_values({})
    return function(point)


@pytest.mark.parametrize(
    ("system", "filter"), [(TWO, psf.EKF()), (RATE, psf.EKF())], ids=["two", "counts"]
)
def test_the_gradient_is_that_of_differences(system, filter, data):
    y, flags = data[COUNTS if system is RATE else system]
    with pm.Model() as model:
        pm.Flat("a")
        pm.Flat("s")
        psf.StateSpace("d", system, filter, steps=STEPS, observed=y, censored=flags)
    point, step = np.array([0.7, 0.5]), 1e-4
    value, slope = value_and_gradient(model, point)
    np.testing.assert_allclose(
        value,
        psf.log_likelihood(
            system, filter, {"a": 0.7, "s": 0.5}, y, steps=STEPS, censored=flags
        ).sum(),
        rtol=1e-12,
    )
    for i, direction in enumerate(np.eye(2) * step):
        sides = [value_and_gradient(model, point + k * direction)[0] for k in (-2, -1, 1, 2)]
        difference = (sides[0] - 8 * sides[1] + 8 * sides[2] - sides[3]) / (12 * step)
        np.testing.assert_allclose(slope[i], difference, rtol=1e-6)


def test_records_of_a_panel_have_the_terms_that_they_have_alone(record):
    """Columns are aligned by name, whatever their order in either table."""
    y, flags = record
    halves = [(STEPS[:15], slice(0, 15)), (STEPS[:15], slice(15, 30))]
    alone = [
        psf.log_likelihood(TWO, psf.EKF(), TRUE, y[own], steps=steps, censored=flags[own])
        for steps, own in halves
    ]
    names = ["direct", "double"]
    together = psf.log_likelihood(
        TWO,
        psf.EKF(),
        TRUE,
        pd.DataFrame(y, columns=names)[names[::-1]],
        steps=np.tile(STEPS[:15], 2),
        panel=np.repeat(["u", "v"], 15),
        censored=xr.DataArray(flags, dims=("row", "sensor"), coords={"sensor": names}),
    )
    np.testing.assert_allclose(together, np.concatenate(alone), rtol=1e-12)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(100)])
def test_a_run_goes_on_whether_its_parts_are_censored_or_not(filter, data):
    y, flags = data[ONE]
    flags = np.where(STEPS[:, None] < 20, 0, flags)
    whole = psf.run_filter(ONE, filter, TRUE, y, steps=STEPS, censored=flags)
    state, terms = None, []
    for own in (slice(0, 8), slice(8, 20), slice(20, 30)):
        given = {"steps": STEPS[own], "censored": flags[own], "state": state}
        state = psf.run_filter(ONE, filter, TRUE, y[own], **given)
        terms.append(state["log_likelihood"].values)
    expected = whole["log_likelihood"].values
    np.testing.assert_allclose(np.concatenate(terms), expected, rtol=1e-13)


@pytest.fixture(scope="module")
def fitted(data):
    """A model of one censored sensor, with one parameter, and draws."""
    y, flags = data[ONE]
    with pm.Model() as model:
        pm.Uniform("a", 0.5, 1.0)
        psf.StateSpace(
            "d", ONE, psf.EKF(), params={"s": 0.6}, steps=STEPS, observed=y, censored=flags
        )
        idata = psf.sample_dram(300, tune=200, chains=2, random_seed=1, progressbar=False)
    return model, idata, y, flags


def test_predictions_are_not_censored_and_residuals_are_of_measured_values(fitted):
    model, idata, y, flags = fitted
    psf.filter_diagnostics(idata, model, random_seed=3, progressbar=False)
    found = idata["filter_diagnostics"]
    below = found["d_predicted"] < np.nanmin(y)
    assert 0.1 < below.mean() < 0.5
    is_measured = (flags == 0) & ~np.isnan(y)
    np.testing.assert_array_equal(np.isfinite(found["d_residual"]), is_measured)
    np.testing.assert_array_equal(np.isfinite(found["d_pit"]), ~np.isnan(y))
    np.testing.assert_array_equal(np.isfinite(found["d_innovation"]), is_measured)
    assert found["d_uniformity"].item() > 0.01
    ahead = psf.forecast(idata, model, n_steps=3, random_seed=4, progressbar=False)
    assert np.isfinite(ahead["predictions"]["d"]).all()
    runs = psf.free_run(idata, model, random_seed=5, progressbar=False)
    assert np.isfinite(runs["free_run"]["d_rmse"])


def test_the_check_of_a_filter_compares_on_the_same_record(fitted):
    model, idata, *_ = fitted
    found = psf.check_filter(idata, model, n_draws=10, random_seed=4, progressbar=False)
    assert set(found["outcome"]) == {"no sign"}
    assert 1e-4 < abs(found["statistic"]).iloc[0] < 0.1
    smoothed = psf.smoothed_states(idata, model, n_draws=20, random_seed=4, progressbar=False)
    exact = psf.smoothed_states(
        idata, model, filter=psf.GridFilter(), n_draws=20, random_seed=4, progressbar=False
    )
    apart = smoothed["smoothed_states"]["d_mean"] - exact["smoothed_states"]["d_mean"]
    assert abs(apart).max() < 0.1


NOT_TAKEN = {
    "EnKF": (ONE, psf.EnKF(50), "EnKF updates members by a Kalman gain"),
    "dependent": (
        psf.StateSpaceModel(
            observation=lambda x: [x[0], x[0]], observation_noise=[[1, 0.1], [0.1, 1]],
            **STEP, **START,
        ),
        psf.EKF(),
        "observation_noise that is not diagonal",
    ),
    "logp": (
        psf.StateSpaceModel(observation_logp=lambda d, x: -((d[0] - x[0]) ** 2), **STEP, **START),
        psf.BootstrapPF(50),
        "which observation_logp does not give",
    ),
    "moments": (COUNTS, psf.IPLF(), "got censored values of observation_dist"),
    "cdf": (
        psf.StateSpaceModel(
            observation_dist=lambda x: [pm.VonMises.dist(x[0], 1.0)], **STEP, **START
        ),
        psf.BootstrapPF(50),
        "of which PyMC has none",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NOT_TAKEN)
def test_what_has_no_probability_is_refused_by_name(case):
    system, filter, message = NOT_TAKEN[case]
    y = np.zeros((2, system.p))
    flags = np.zeros((2, system.p))
    flags[1, 0] = -1
    with pytest.raises(ModelError, match=message):
        psf.log_likelihood(system, filter, TRUE, y, steps=[0, 1], censored=flags)
    with pm.Model(), pytest.raises(ModelError, match=message):
        psf.StateSpace("d", system, filter, params=TRUE, steps=[0, 1], observed=y, censored=flags)


WRONG = {
    "shape": ([[0], [0], [-1]], r"shape of observed, \(3, 2\) .*got \(3, 1\)"),
    "value": ([[0, 0], [0, 2], [0, 0]], r"got 2 in row 1, column 'double'"),
    "missing": ([[0, 0], [-1, 0], [0, 0]], r"0 where observed is NaN.*got -1 in row 1, .*'direct'"),
    "infinite": ([[0, 0], [0, np.inf], [0, 0]], r"censored\[1, 1\] = inf"),
    "truth": (np.zeros((3, 2), bool), "got truth values: write -1"),
    "names": (pd.DataFrame(np.zeros((3, 2)), columns=["direct", "other"]), "'other'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_flags_are_told_with_their_place(case):
    flags, message = WRONG[case]
    y = np.array([[0.0, 0.0], [np.nan, 0.0], [0.0, 0.0]])
    with pytest.raises(ModelError, match=message):
        psf.log_likelihood(TWO, psf.EKF(), TRUE, y, steps=[0, 1, 2], censored=flags)


def test_simulations_and_symbolic_steps_take_no_flags():
    with pm.Model(), pytest.raises(ModelError, match="censored must be None where observed"):
        psf.StateSpace("d", ONE, psf.EKF(), params=TRUE, steps=[0, 1], censored=[-1, 0])
    with pm.Model():
        steps = pm.Data("steps", [0, 1])
        with pytest.raises(ModelError, match="steps and panel must be numbers beside censored"):
            psf.StateSpace(
                "d", ONE, psf.EKF(), params=TRUE, steps=steps, observed=[0, 0], censored=[-1, 0]
            )


def test_rows_that_extend_a_run_keep_the_flags_of_those_before(data):
    """The run over five rows, of which the last is censored, and three more is that over eight."""
    y, flags = (part[17:25] for part in data[ONE])
    assert flags[4] != 0
    assert (flags[5:] != 0).any()

    def run_over(rows):
        with pm.Model() as model:
            pm.Uniform("a", 0.5, 1.0)
            given = {"observed": y[rows], "censored": flags[rows], "steps": np.arange(8)[rows]}
            psf.StateSpace("d", ONE, psf.EKF(), params={"s": 0.6}, **given)
            settings = {"data": "sequential", "populations": 2, "random_seed": 1}
            return model, psf.sample_smc(60, progressbar=False, **settings)

    model, run = run_over(slice(0, 5))
    longer = {"observed": y, "steps": np.arange(8), "progressbar": False}
    found = psf.extend(run, model, censored=flags, **longer)
    expected = run_over(slice(0, 8))[1]
    assert found.attrs["log_evidence"] == pytest.approx(expected.attrs["log_evidence"], abs=1e-9)
    without = psf.extend(run, model, **longer)
    assert abs(without.attrs["log_evidence"] - expected.attrs["log_evidence"]) > 0.1


def test_a_table_in_long_format_has_columns_of_flags():
    frame = pd.DataFrame({
        "who": ["A", "B", "A", "B"], "t": [2.0, 1.0, 0.0, 2.0], "v": [1.0, 2, 3, 4],
        "w": [5.0, 6, 7, 8], "cv": [0, -1, 1, 0], "cw": [1, 0, 0, -1],
    })  # fmt: skip
    columns = {"record": "who", "time": "t", "dt": 1.0}
    found = psf.panel_from(frame, values=["v", "w"], censored=["cv", "cw"], **columns)
    expected = pd.DataFrame({"v": [1.0, 0, -1, 0], "w": [0.0, 1, 0, -1]})
    pd.testing.assert_frame_equal(found["censored"], expected)
    one = psf.panel_from(frame, values="v", censored="cv", **columns)
    np.testing.assert_array_equal(one["censored"].ravel(), [1, 0, -1, 0])
    with pytest.raises(ModelError, match=r"a column for each of \['v', 'w'\], got \['cv'\]"):
        psf.panel_from(frame, values=["v", "w"], censored="cv", **columns)
