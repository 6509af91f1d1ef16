"""Modes: against eigenvalues by numpy and closed forms, in continuous and discrete time."""

import pickle

import arviz as az
import numpy as np
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from tests.systems import FORCED, PAIR

COLUMNS = ["frequency", "damping_ratio", "growth_rate", "time_constant"]


def system_of(drift, start, length=0.01, **changes):
    n = len(start)
    settings = dict(
        transition=drift and psf.EulerMaruyama(drift, np.eye(n), length, substeps=2),
        observation=lambda x: [x[0]],
        observation_noise=[[0.01]],
        initial_mean=start,
        initial_cov=np.eye(n),
    )
    return psf.StateSpaceModel(**settings | changes)


def oscillator(x, k, c):
    return [x[1], -k * x[0] - c * x[1]]


def well(x, a, b):
    """Rest points at 0, which is unstable, and at +-sqrt(a / b), with the slope -2 a."""
    return [a * x[0] - b * x[0] ** 3]


MASSES, SPRINGS = np.diag([1.0, 2.0]), np.array([[7.0, -3.0], [-3.0, 3.5]])
DAMPING = np.array([[0.3, -0.1], [-0.1, 0.2]])


def two_masses():
    inverse = np.linalg.inv(MASSES)
    block = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ SPRINGS, -inverse @ DAMPING]])
    eigenvalues = np.linalg.eigvals(block)
    return sorted((s for s in eigenvalues if s.imag > 0), key=lambda s: s.imag)


def test_a_system_of_two_masses():
    drift = psf.mechanics.second_order(MASSES, DAMPING, SPRINGS)
    modes = psf.mechanics.linear_modes(system_of(drift, [0.5, 0.0, 0.0, 1.0]), {})
    assert list(modes.columns) == COLUMNS
    assert modes.index.tolist() == [0, 1]
    s = np.array(two_masses())
    for name, expected in (
        ("frequency", s.imag / (2 * np.pi)),
        ("damping_ratio", -s.real / abs(s)),
        ("growth_rate", s.real),
        ("time_constant", -1 / s.real),
    ):
        np.testing.assert_allclose(modes[name], expected, rtol=1e-10)
    np.testing.assert_allclose(list(modes.attrs["at"].values()), 0.0, atol=1e-12)
    assert modes.attrs["eigenvalues_of"] == "drift"


def test_real_and_growing_modes():
    """Overdamped: two real modes; a growing oscillation; and a double well at its top."""
    system = system_of(oscillator, [1.0, 0.0])
    modes = psf.mechanics.linear_modes(system, {"k": 2.0, "c": 3.0})
    np.testing.assert_allclose(modes["growth_rate"], [-1.0, -2.0])
    np.testing.assert_allclose(modes["time_constant"], [1.0, 0.5])
    np.testing.assert_array_equal(modes[["frequency", "damping_ratio"]], [[0, 1], [0, 1]])
    (growing,) = psf.mechanics.linear_modes(system, {"k": 1.0, "c": -0.2}).values
    omega = np.sqrt(1 - 0.01)
    np.testing.assert_allclose(growing, [omega / (2 * np.pi), -0.1, 0.1, 10.0])
    top = psf.mechanics.linear_modes(system_of(well, [0.0]), {"a": 3.0, "b": 3.0})
    np.testing.assert_allclose(top.values, [[0.0, -1.0, 3.0, 1 / 3]])


def test_a_rest_point_off_zero():
    """The nearest well, from a start that Newton's full step would leave for the other one."""
    params = {"a": 3.0, "b": 3.0}
    for start in (0.6, 0.9, 40.0):
        modes = psf.mechanics.linear_modes(system_of(well, [start]), params)
        np.testing.assert_allclose(modes.attrs["at"]["x0"], 1.0, rtol=1e-10)
        np.testing.assert_allclose(modes["growth_rate"], [-6.0])
    given = psf.mechanics.linear_modes(system_of(well, [5.0]), params, at=[0.5])
    np.testing.assert_allclose(given["growth_rate"], [3.0 - 9.0 * 0.25])
    assert given.attrs["at"] == {"x0": 0.5}


def test_inputs_and_time_are_zero():
    system = system_of(
        lambda x, u, t, k: [1.0 - k * x[0] + u[0] + t], [0.0], inputs=["force"]
    )  # fmt: skip
    modes = psf.mechanics.linear_modes(system, {"k": 2.0})
    np.testing.assert_allclose(modes.attrs["at"]["x0"], 0.5)


def test_steps_have_the_logarithms_of_their_eigenvalues():
    """A mode that flips its sign oscillates with half the rate of the steps; 0 ends at once."""
    F = np.array([[0.9, 0.3], [-0.3, 0.8]])
    settings = dict(process_noise=[[1.0]], dt=0.5)
    turning = system_of(
        None, [1.0, 0.0], transition=lambda x, q: [*(pt.as_tensor(F) @ x + [q[0], 0.0])], **settings
    )
    s = np.log(next(v for v in np.linalg.eigvals(F) if v.imag > 0)) / 0.5
    modes = psf.mechanics.linear_modes(turning, {})
    np.testing.assert_allclose(modes["frequency"], [s.imag / (2 * np.pi)])
    np.testing.assert_allclose(modes["growth_rate"], [s.real])
    assert modes.attrs["eigenvalues_of"] == "step"
    flipping = system_of(
        None, [1.0, 1.0], transition=lambda x, q: [-0.5 * x[0] + q[0], 0.0 * x[1]], **settings
    )
    ended, flipped = psf.mechanics.linear_modes(flipping, {}).values
    np.testing.assert_allclose(flipped[[0, 2]], [1.0, np.log(0.5) / 0.5])
    np.testing.assert_array_equal(ended, [0.0, 1.0, -np.inf, 0.0])


def test_a_line_of_rest_points():
    """Nothing holds the position: a mode that neither grows nor decays."""
    modes = psf.mechanics.linear_modes(
        system_of(lambda x, c: [x[1], -c * x[1]], [3.0, 1.0]), {"c": 2.0}
    )
    np.testing.assert_allclose(modes["growth_rate"], [0.0, -2.0], atol=1e-12)
    assert modes.attrs["at"]["x1"] == pytest.approx(0.0, abs=1e-12)


def test_the_steps_of_an_unpickled_system():
    """They know the drift no more; their eigenvalues differ by about the step's length."""
    system = system_of(oscillator, [1.0, 0.0], length=1e-3)
    params = {"k": 4.0, "c": 0.2}
    exact = psf.mechanics.linear_modes(system, params)
    copied = psf.mechanics.linear_modes(pickle.loads(pickle.dumps(system)), params)
    assert copied.attrs["eigenvalues_of"] == "step"
    np.testing.assert_allclose(copied["frequency"], exact["frequency"], rtol=1e-3)
    # A substep of length h turns s into log(1 + h s) / h = s - h s^2 / 2.
    shift = 1e-3 / 2 * (4.0 - 2 * 0.01) / 2
    np.testing.assert_allclose(copied["growth_rate"], exact["growth_rate"] + shift, rtol=1e-4)


def draws_of(n=40):
    rng = np.random.default_rng(1)
    return {"k": rng.uniform(3.0, 5.0, (2, n)), "c": rng.uniform(0.1, 0.3, (2, n))}


def test_draws_have_medians_and_intervals():
    system, draws = system_of(oscillator, [1.0, 0.0]), draws_of()
    modes = psf.mechanics.linear_modes(system, draws)
    assert list(modes.columns) == [
        f"{name}{end}" for name in COLUMNS for end in ("", "_low", "_high")
    ]
    frequencies = np.sqrt(draws["k"] - draws["c"] ** 2 / 4) / (2 * np.pi)
    rates = -draws["c"] / 2
    for name, values in (("frequency", frequencies), ("growth_rate", rates)):
        expected = [np.median(values), *np.quantile(values, [0.05, 0.95])]
        found = modes[[name, f"{name}_low", f"{name}_high"]].values[0]
        np.testing.assert_allclose(found, expected, rtol=1e-10)
    idata = az.from_dict({"posterior": draws | {"unused": np.zeros((2, 40, 3))}})
    named = {name: idata["posterior"][name] for name in draws}
    for posterior in (idata, idata["posterior"].to_dataset(), named):
        assert psf.mechanics.linear_modes(system, posterior).equals(modes)
    turned = idata["posterior"].to_dataset().transpose("draw", "chain", ...)
    np.testing.assert_allclose(psf.mechanics.linear_modes(system, turned), modes, rtol=1e-12)


def test_arrays_of_parameters():
    system = system_of(
        lambda x, k: [x[1], -k[0] * x[0] - k[1] * x[1]], [1.0, 0.0], shapes={"k": (2,)}
    )
    draws = draws_of()
    together = np.stack([draws["k"], draws["c"]], axis=-1)
    idata = az.from_dict({"posterior": {"k": together}})
    expected = psf.mechanics.linear_modes(system_of(oscillator, [1.0, 0.0]), draws)
    np.testing.assert_allclose(psf.mechanics.linear_modes(system, idata), expected, rtol=1e-12)


def test_modes_are_matched_over_draws():
    """Two oscillators that change places, and with them numpy's order of the eigenvalues.

    Sorted by damping they would mix: it is drawn alike for both.
    """
    rng = np.random.default_rng(2)
    k = rng.uniform([1.0, 9.0], [2.0, 12.0], (500, 2))
    c = rng.uniform(0.1, 0.9, (500, 2))

    def drift(x, k, c, order):
        first = pt.switch(order > 0, 0, 1)
        return [x[1], -k[first] * x[0] - c[first] * x[1],
                x[3], -k[1 - first] * x[2] - c[1 - first] * x[3]]  # fmt: skip

    system = system_of(drift, [0.0] * 4, shapes={"k": (2,), "c": (2,)})
    modes = psf.mechanics.linear_modes(system, {"k": k, "c": c, "order": rng.normal(size=500)})
    np.testing.assert_allclose(modes["growth_rate"], -np.median(c, axis=0) / 2, rtol=1e-9)
    frequencies = np.sqrt(k - c**2 / 4) / (2 * np.pi)
    for end, prob in (("_low", 0.05), ("", 0.5), ("_high", 0.95)):
        expected = np.quantile(frequencies, prob, axis=0)
        np.testing.assert_allclose(modes[f"frequency{end}"], expected, rtol=1e-9)


def test_rest_points_of_draws():
    """At each draw its own: the slope is -2 a there, whatever b."""
    rng = np.random.default_rng(3)
    a, b = rng.uniform(1.0, 3.0, (2, 200))
    modes = psf.mechanics.linear_modes(system_of(well, [0.9]), {"a": a, "b": b})
    np.testing.assert_allclose(modes["growth_rate_low"], np.quantile(-2 * a, [0.05]), rtol=1e-9)
    assert modes.attrs["at"]["x0"] == pytest.approx(np.sqrt(np.median(a) / np.median(b)))


FALLING = system_of(lambda x, g: [x[1], -g], [0.0, 0.0])
KINKED = system_of(lambda x, k: [x[1], -k * pt.sqrt(x[0])], [0.0, 0.0])
WRONG = [
    (FALLING, {"g": 9.81}, {}, r"no rest point by Newton's .*mean \[0.0, 0.0\] with zero.* at="),
    (FALLING, {"g": np.array([0.0, 9.81, 1.0])}, {}, "no rest point at 2 of 3 draws"),
    (KINKED, {"k": 1.0}, {}, r"finite derivatives at the state .*got others at \[0.0, 0.0\]"),
    (FALLING, {}, {}, r"no value for the parameters \['g'\]"),
    (FALLING, {"g": 1.0}, {"at": [0.0]}, r"for each of the states \['x0', 'x1'\], got \[0.0\]"),
    (FALLING, {"g": 1.0}, {"at": "rest"}, "got 'rest'"),
    ("system", {"g": 1.0}, {}, "system must be a StateSpaceModel"),
    (FALLING, az.from_dict({"prior": {"g": np.ones((1, 2))}}), {}, "group 'posterior', got"),
]


@pytest.mark.parametrize(("system", "params", "settings", "message"), WRONG)
def test_what_has_no_modes(system, params, settings, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.mechanics.linear_modes(system, params, **settings)


def test_a_table_is_narrow_enough_for_a_terminal():
    text = psf.mechanics.linear_modes(PAIR, {"a": 0.5}).to_string()
    assert max(map(len, text.splitlines())) <= 80
    assert len(psf.mechanics.linear_modes(FORCED, {"a": 0.5})) == 1


def test_parameters_of_each_record_are_no_draws():
    draws = xr.Dataset({"a": (("chain", "draw", "patient"), np.full((2, 5, 3), 0.5))})
    with pytest.raises(
        psf.errors.ModelError, match=r"got the dimension 'patient' too: .*isel\(patient=0"
    ):
        psf.mechanics.linear_modes(FORCED, draws)
    assert len(psf.mechanics.linear_modes(FORCED, draws.isel(patient=0))) == 1
