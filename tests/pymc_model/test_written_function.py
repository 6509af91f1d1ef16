"""Log-densities written out as scalar code: the numbers and the errors of the graph."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from numba import njit
from numba.core import event
from pytensor.raise_op import Assert

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.pytensor_function import NativeFunction, make_call
from pymc_statespace_filters.pymc_model.density import ModelDensity, compile_raveled
from pymc_statespace_filters.pymc_model.inspection import health_outputs, noise_seeds
from pymc_statespace_filters.pymc_model.written_function import WrittenFunction, native_function
from tests.modes import AS_IT_STANDS
from tests.systems import autoregression

SYSTEM = autoregression(spread=0.5**0.5)
DATA = np.array([0.3, 0.5, -0.1, np.nan, 0.9, 0.2, -0.3, 0.1])
RECORD = {"steps": np.arange(1, 9), "observed": DATA}


@njit
def call(bound):
    return make_call(bound)


def compiled(model, **options):
    """PyTensor's function of a model's log-density, its prior and its filters' health."""
    shared = noise_seeds(model)
    outputs = [model.logp(), model.logp(vars=model.free_RVs), *health_outputs([model.logp()])]
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    function, start = compile_raveled(model.initial_point(), outputs, values, shared, **options)
    return function, [start, *(np.array(seed.get_value()) for seed in shared.values())]


def assert_written_out(model):
    """The model's function is scalar code, with the numbers of the graph at many points."""
    function, example = compiled(model)
    written = native_function(function, example)
    truth = NativeFunction(compiled(model, mode=AS_IT_STANDS)[0], example)
    assert isinstance(written, WrittenFunction)
    assert written.kinds == truth.kinds
    rng = np.random.default_rng(1)
    for scale in (0.1, 1.0, 6.0):
        x = example[0] + scale * rng.standard_normal(example[0].shape)
        seeds = [np.array(seed) for seed in rng.integers(2**62, size=len(example) - 1)]
        found, exact = written(x, *seeds), truth(x, *seeds)
        for value, expected in zip(found, exact, strict=True):
            np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_priors_of_many_laws_and_records_of_several_filters():
    with pm.Model() as model:
        level = pm.Normal("level", 0.0, pm.HalfCauchy("width", 1.0))
        phi = pm.Beta("phi", 2.0, 3.0)
        shares = pm.Dirichlet("shares", [1.0, 2.0, 3.0])
        pm.Uniform("end", -1.0, pm.Gamma("high", 2.0, 1.0))
        weights = pm.StudentT("weights", 4.0, mu=pm.LogNormal("mu", 0.0, 1.0), sigma=2.0, shape=3)
        pm.Potential("sum", -((weights * shares).sum() ** 2))
        pm.Normal("y", level + phi * np.arange(20.0), 2.0, observed=np.sqrt(np.arange(20.0)))
        psf.StateSpace("exact", SYSTEM, psf.EKF(), params={"phi": phi}, **RECORD)
        psf.StateSpace("noisy", SYSTEM, psf.BootstrapPF(20), params={"phi": shares[1]}, **RECORD)
    assert_written_out(model)


def test_rows_that_are_not_scored_and_panels():
    panel = np.repeat(["a", "b"], 4)
    with pm.Model() as model:
        phi = pm.Normal("phi", 0.5, 0.2, shape=2)
        psf.StateSpace("later", SYSTEM, psf.EKF(), params={"phi": phi}, panel=panel, score_from=2,
                       steps=[1, 2, 3, 5] * 2, observed=DATA)  # fmt: skip
        psf.StateSpace("late", SYSTEM, psf.EKF(), params={"phi": phi[0]}, score_from=3, **RECORD)
        psf.StateSpace("panel", SYSTEM, psf.BootstrapPF(10), params={"phi": phi}, panel=panel,
                       steps=[1, 2, 3, 5] * 2, observed=DATA)  # fmt: skip
    assert_written_out(model)


def test_errors_are_those_of_the_graph():
    """Of a parameter outside its domain, and of a record that does not fit."""
    x = pt.dvector("x")
    checked = Assert("x must be positive")(x[0] ** 2, x[0] > 0.0)
    function = pytensor.function([x], checked + 1.0, mode="NUMBA")
    position = np.array([2.0])
    written = native_function(function, [position])
    assert isinstance(written, WrittenFunction)
    bound, repeat = written.bind([position])
    assert call(bound)
    assert bound.out[1] == 5.0
    position[:] = -1.0
    assert not call(bound)
    with pytest.raises(AssertionError, match="x must be positive"):
        repeat()

    with pm.Model(coords={"row": range(8)}) as model:
        pm.Normal("phi", 0.5, 0.2)
        observed = pm.Data("observed", np.ones((8, 1)), dims=("row", "column"))
        psf.StateSpace("d", SYSTEM, psf.EKF(), steps=np.arange(1, 9), observed=observed)
    model["observed"].set_value(np.ones((5, 1)))
    with pytest.raises(psf.errors.ModelError, match="observed must have a row for each step"):
        ModelDensity(model).evaluate(np.zeros((1, 1)))


def test_calls_bound_side_by_side_do_not_share_memory():
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.2)
        psf.StateSpace("d", SYSTEM, psf.BootstrapPF(20), **RECORD)
    function, example = compiled(model)
    written = native_function(function, example)
    bounds = [written.bind([np.array([phi]), np.array(7)]) for phi in (0.2, 0.6)]
    assert all(call(bound) for bound, _ in bounds)
    for (bound, _), phi in zip(bounds, (0.2, 0.6), strict=True):
        assert bound.out[1] == written(np.array([phi]), np.array(7))[0]


def test_another_model_compiles_nothing_by_numba():
    def density(scale):
        with pm.Model() as model:
            pm.Normal("phi", 0.5, scale)
            psf.StateSpace("d", SYSTEM, psf.EKF(), **RECORD)
        ModelDensity(model).evaluate(np.zeros((3, 1)))

    density(0.2)
    with event.install_recorder("numba:compile") as recorded:
        density(0.3)
    assert not recorded.buffer


@pytest.mark.parametrize("size", [400, 3000])
def test_many_operations_are_left_to_numba(size):
    x, data = pt.dvector("x"), pytensor.shared(np.arange(float(size)))
    function = pytensor.function([x], pt.exp(x[0] * data).sum(), mode="NUMBA")
    example = [np.array([0.001])]
    found = native_function(function, example)
    assert not isinstance(found, WrittenFunction)
    assert found(*example)[0] == pytest.approx(np.exp(0.001 * np.arange(size)).sum(), rel=1e-12)


def with_gradient(model, **options):
    """The function of a model's log-density and its gradient by the vector of all variables."""
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    density = model.logp()
    gradient = pt.concatenate([pt.flatten(part) for part in pytensor.grad(density, values)])
    return compile_raveled(model.initial_point(), [density, gradient], values, **options)


@pytest.mark.parametrize("panel", [False, True])
def test_gradients(panel):
    """Both passes of each filter, also after a forward pass that failed and left no tape."""
    with pm.Model() as model:
        pm.LogNormal("spread", 0.0, 1.0)
        pm.Normal("phi", 0.5, 0.2, shape=2 if panel else ())
        record = {"steps": [1, 2, 3, 5] * 2, "panel": ["a"] * 4 + ["b"] * 4} if panel else RECORD
        system = autoregression()
        for name, more in {"d": {}, **({} if panel else {"e": {"score_from": 2}})}.items():
            psf.StateSpace(name, system, psf.EKF(), **record | {"observed": DATA} | more)
    function, start = with_gradient(model)
    written = native_function(function, [start])
    assert isinstance(written, WrittenFunction)
    truth, _ = with_gradient(model, mode=AS_IT_STANDS)
    position = start.copy()
    bound, _ = written.bind([position])
    rng = np.random.default_rng(2)
    for i in range(4):
        position[:] = start + 0.3 * rng.standard_normal(start.size)
        if i == 2:
            position[0] = 800.0  # no covariance
        expected = truth(position)
        assert call(bound)
        if i != 2:
            np.testing.assert_allclose(bound.out[1], expected[0], rtol=1e-11)
            np.testing.assert_allclose(bound.out[2:], expected[1], rtol=1e-9, atol=1e-12)
            np.testing.assert_array_equal(written(position)[1], bound.out[2:])
        else:
            assert bound.out[1] == expected[0] == -np.inf
