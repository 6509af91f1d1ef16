"""A log-density at many points: the model's own, whoever evaluates it and in how many threads."""

import time
import warnings
from threading import Thread

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.ops import wrap_py

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native import rows as many_calls
from pymc_statespace_filters.pymc_model import density
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.inspection import noise_seeds
from pymc_statespace_filters.pymc_model.switched_density import SwitchedDensity, Switches
from tests.interrupts import interrupt
from tests.systems import autoregression

DATA = np.array([0.3, 0.5, -0.1, 0.4, 0.9, 0.2, -0.3, 0.1])


def model_of(*filters):
    with pm.Model() as model:
        phi = pm.Normal("phi", 0.5, 0.3, shape=2)
        for i, filter in enumerate(filters):
            system = autoregression(spread=0.5**0.5)
            psf.StateSpace(
                f"d{i}",
                system,
                filter,
                params={"phi": phi[i % 2]},
                steps=range(1, 9),
                observed=DATA,
            )
    return model


@pytest.fixture(scope="module")
def noisy():
    return ModelDensity(model_of(psf.BootstrapPF(20), psf.BootstrapPF(30)))


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(1)
    return rng.normal(0.5, 0.3, (23, 2)), rng.integers(2**62, size=(23, 2))


def test_each_point_has_its_own_seeds(noisy, points):
    x, seeds = points
    found = noisy.evaluate(x, seeds)
    shared = noise_seeds(noisy.model)
    log_density = noisy.model.compile_logp()
    for i in (0, 7, 22):
        for column, seed in enumerate(shared.values()):
            seed.set_value(seeds[i, column])
        assert found[i] == pytest.approx(log_density({"phi": x[i]}), rel=1e-12)


def test_many_parameters_without_a_compiler_of_c():
    with pm.Model() as model, pytensor.config.change_flags(cxx=""):
        rates = [pm.LogNormal(f"rate_{i}") for i in range(16)]
        psf.StateSpace(
            "d",
            autoregression(spread=0.5**0.5),
            psf.EKF(),
            params={"phi": 1 / (1 + sum(rates))},
            steps=range(1, 9),
            observed=DATA,
        )
        with pytest.warns(UserWarning, match="Loop fusion failed"):
            model.compile_logp()
        # It warns of nothing, which here is an error.
        psf.sample_dram(
            draws=4, tune=4, chains=1, progressbar=False, compute_convergence_checks=False
        )


def test_other_warnings_of_a_compilation_are_shown(monkeypatch):
    def compile_and_warn(inputs, outputs):
        warnings.warn("Loop fusion failed because of the number of operands", stacklevel=1)
        warnings.warn("something else", stacklevel=1)

    monkeypatch.setattr(density, "compile_pymc", compile_and_warn)
    with pytest.warns(UserWarning, match="something else") as shown:
        density.compile_density([], [])
    assert [str(warning.message) for warning in shown] == ["something else"]


@pytest.mark.parametrize("in_a_block", [False, True])
def test_filters_of_warnings_that_another_thread_sets_survive_a_compilation(
    monkeypatch, in_a_block
):
    def sets_a_filter():
        if in_a_block:
            block.__enter__()
        warnings.filterwarnings("ignore", "of another thread")

    def compile_meanwhile(inputs, outputs):
        other = Thread(target=sets_a_filter)
        other.start()
        other.join()

    with warnings.catch_warnings():
        block, before = warnings.catch_warnings(), list(warnings.filters)
        monkeypatch.setattr(density, "compile_pymc", compile_meanwhile)
        density.compile_density([], [])
        assert [f[1].pattern for f in warnings.filters[:1]] == ["of another thread"]
        assert warnings.filters[1:] == before
        warnings.warn("of another thread", stacklevel=1)
        if in_a_block:
            block.__exit__(None, None, None)
            assert warnings.filters == before


def test_a_filter_of_the_same_warning_survives_a_compilation(monkeypatch):
    monkeypatch.setattr(density, "compile_pymc", lambda inputs, outputs: None)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "Loop fusion failed", UserWarning)
        warnings.filterwarnings("ignore", "Loop fusion failed", UserWarning)
        before = list(warnings.filters)
        density.compile_density([], [])
        assert warnings.filters == before


@pytest.mark.parametrize("n_threads", [1, 2, 5, 40])
def test_threads_do_not_matter(noisy, points, n_threads, monkeypatch):
    expected = noisy.evaluate(*points)
    monkeypatch.setattr(many_calls, "available_cores", lambda: n_threads)
    np.testing.assert_array_equal(noisy.evaluate(*points), expected)


def test_no_points_no_values(noisy):
    assert noisy.evaluate(np.empty((0, 2)), np.empty((0, 2), dtype=np.int64)).shape == (0,)


def test_the_watch_hears_of_every_point(noisy, points, monkeypatch):
    counts = []
    monkeypatch.setattr(noisy.calls, "on_progress", counts.append)
    noisy.evaluate(*points)
    assert sum(counts) == 23


def test_failed_estimates_are_minus_infinity():
    density = ModelDensity(model_of(psf.EKF()))
    with np.errstate(over="ignore"):
        found = density.evaluate(np.array([[0.5, 0.5], [1e300, 0.5]]), np.empty((2, 0)))
    assert np.isfinite(found[0])
    assert np.isneginf(found[1])


def python_model(function):
    """A model whose likelihood is a Python function, which machine code calls back."""
    wrapped = wrap_py([pt.dscalar], [pt.dscalar])(function)
    with pm.Model() as model:
        pm.Potential("p", wrapped(pm.Normal("x", 0, 1)))
    return model


@pytest.mark.filterwarnings("ignore:Numba will use object mode")
def test_an_exception_of_the_model_is_raised():
    def picky(x):
        if x > 1.0:
            raise ArithmeticError("too large")
        return np.asarray(x)

    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        density = ModelDensity(python_model(picky))
    seeds = np.empty((3, 0))
    assert np.isfinite(density.evaluate(np.zeros((3, 1)), seeds)).all()
    with pytest.raises(ArithmeticError, match="too large"):
        density.evaluate(np.array([[0.0], [2.0], [0.5]]), seeds)


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_stops_all_threads():
    calls = []

    def slow(x):
        calls.append(x)
        if len(calls) == 20:
            interrupt()
        time.sleep(0.01)
        return np.asarray(x)

    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        density = ModelDensity(python_model(slow))
    calls.clear()
    with pytest.raises(KeyboardInterrupt):
        density.evaluate(np.zeros((10_000, 1)), np.empty((10_000, 0)))
    assert 20 <= len(calls) < 10_000


# The density with scalars held equals that of a model made without them.


def full_model():
    with pm.Model() as model:
        scale = pm.HalfNormal("scale", 1)
        b = pm.Normal("b", 0, scale, shape=3)
        c = pm.HalfNormal("c", 2)
        low = pm.Uniform("low", 0, 1 + c)  # the support depends on a scalar that may be held
        weights = pm.Dirichlet("weights", np.ones(3))
        pm.Potential("near", -0.1 * (low - c) ** 2)
        pm.Deterministic("total", b.sum() + c)
        pm.Normal("y", b.sum() + c + low + weights[0], 0.5, observed=[0.3, 1.2])
    return model


def test_held_scalars_leave_the_density_of_the_others():
    model = full_model()
    density = SwitchedDensity(
        model, Switches((np.array([2]), np.array([4])), (np.array([0.0]), np.array([0.0])))
    )
    x = np.random.default_rng(1).standard_normal((2, 8))
    x[1] = x[0]
    x[1, [2, 4]] += 5.0  # columns of what is held
    seeds = np.empty((2, 0), dtype=np.int64)
    on, off = np.ones((2, 2), dtype=bool), np.zeros((2, 2), dtype=bool)
    np.testing.assert_allclose(
        density.evaluate_in_parts(x, on, seeds).total, ModelDensity(model).evaluate(x), rtol=1e-12
    )
    found = density.evaluate_in_parts(x, off, seeds)
    np.testing.assert_array_equal(found.total, found.total[0])
    # Without the priors of the scalars that are held.
    with pm.Model() as rest:
        scale = pm.HalfNormal("scale", 1)
        b = pm.Normal("b", 0, scale, shape=2)
        low = pm.Uniform("low", 0, 1)
        weights = pm.Dirichlet("weights", np.ones(3))
        pm.Potential("near", -0.1 * low**2)
        pm.Normal("y", b.sum() + low + weights[0], 0.5, observed=[0.3, 1.2])
    others = x[:1, [0, 1, 3, 5, 6, 7]]
    np.testing.assert_allclose(found.total[:1], ModelDensity(rest).evaluate(others), rtol=1e-12)
    own = np.zeros(found.held.shape[1])
    scale_there = np.exp(x[0, 0])
    own[2] = -np.log(scale_there) - 0.5 * np.log(2 * np.pi)
    own[4] = 0.5 * np.log(2 / np.pi) - np.log(2)
    np.testing.assert_allclose(found.held[0], own, rtol=1e-8)  # PyMC has log 2 as float32
    assert density.blocks.tolist() == [0, 1, 2, 3, 4, 5, 6, 6]
    values = density.constrained([model["b"], model["c"], model["total"]])(x, off)
    assert (values["c"] == 0).all()
    assert (values["b"][:, 1] == 0).all()
    np.testing.assert_allclose(values["total"], values["b"].sum(axis=1), rtol=1e-12)
