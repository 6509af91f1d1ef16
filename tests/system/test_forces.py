"""Forces against a transcription of thesis, Eqs. 5.20-5.23, and against what follows from it."""

import itertools

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.forces import cubic, freeplay, hysteresis, hysteresis_branch
from tests.modes import AS_IT_STANDS

pytestmark = pytest.mark.usefixtures("interpreted")

STIFFNESS, START, LENGTH, GAP = 1.3, 0.4, 0.7, 0.25
GRID = np.linspace(-3.0, 3.0, 1201)  # holds the kinks, and points between them
WIDTHS = [0.05, 0.3, 2.0]  # the last one so wide that neighbouring bends overlap
FORCES = {
    "freeplay": lambda z, width: freeplay(z, STIFFNESS, GAP, width=width),
    "rising": lambda z, width: hysteresis(z, 1.0, STIFFNESS, START, LENGTH, width=width),
    "falling": lambda z, width: hysteresis(z, -1.0, STIFFNESS, START, LENGTH, width=width),
}


def printed_freeplay(u, k_f, delta_f):
    if u > delta_f:
        return k_f * (u - delta_f)
    if u < -delta_f:
        return k_f * (u + delta_f)
    return 0.0


def printed_hysteresis(u, velocity, k_h, a_h, delta_h):
    f_0 = 0.5 * k_h * (2 * a_h + delta_h)
    if velocity >= 0:
        if u < a_h:
            return k_h * (u - a_h) + f_0
        if u <= delta_h + a_h:
            return f_0
        return k_h * (u - a_h - delta_h) + f_0
    if u > -a_h:
        return k_h * (u + a_h) - f_0
    if u >= -(a_h + delta_h):
        return -f_0
    return k_h * (u + a_h + delta_h) - f_0


@pytest.fixture(scope="module", params=FORCES)
def force(request):
    """A force as a function of displacements and width; `order` asks for a derivative."""
    z = pt.dvector("z")
    compiled = {}

    def evaluate(displacements, width=None, order=0):
        if (width, order) not in compiled:
            value = FORCES[request.param](z, width)
            for _ in range(order):
                value = pytensor.grad(value.sum(), z)
            compiled[width, order] = pytensor.function([z], value, mode=AS_IT_STANDS)
        return compiled[width, order](np.asarray(displacements))

    return evaluate


def test_cubic_is_equation_5_20():
    np.testing.assert_allclose(
        cubic(GRID, 1.5, -0.2).eval(), [1.5 * u - 0.2 * u**3 for u in GRID], rtol=1e-14, atol=1e-15
    )


def test_freeplay_is_equation_5_21():
    expected = [printed_freeplay(u, STIFFNESS, GAP) for u in GRID]
    np.testing.assert_allclose(freeplay(GRID, STIFFNESS, GAP).eval(), expected, atol=1e-14)


@pytest.mark.parametrize("velocity", [2.0, 1e-300, 0.0, -0.0, -1e-300, -2.0])
def test_hysteresis_is_equations_5_22_and_5_23(velocity):
    expected = [printed_hysteresis(u, velocity, STIFFNESS, START, LENGTH) for u in GRID]
    actual = hysteresis(GRID, velocity, STIFFNESS, START, LENGTH).eval()
    np.testing.assert_allclose(actual, expected, atol=1e-14)


def test_hysteresis_takes_the_loop_area_out_of_a_full_cycle():
    rising = hysteresis(GRID, 1.0, STIFFNESS, START, LENGTH).eval()
    falling = hysteresis(GRID, -1.0, STIFFNESS, START, LENGTH).eval()
    # The kinks lie on the grid, so the trapezoidal rule is exact; positive: energy goes out.
    loss = np.trapezoid(rising, GRID) - np.trapezoid(falling, GRID)
    f_0 = STIFFNESS * (2 * START + LENGTH) / 2
    assert loss == pytest.approx(2 * f_0 * LENGTH, rel=1e-12)


def test_branches_of_hysteresis_meet_outside_the_loop():
    outside = np.array([-5.0, -START - LENGTH, START + LENGTH, 5.0])
    rising = hysteresis(outside, 1.0, STIFFNESS, START, LENGTH).eval()
    falling = hysteresis(outside, -1.0, STIFFNESS, START, LENGTH).eval()
    np.testing.assert_allclose(rising, falling, atol=1e-14)


@pytest.mark.parametrize("branch", [1.0, -1.0])
def test_a_branch_is_left_at_the_ends_of_the_loop_alone(branch):
    end = START + LENGTH
    displacements = [-9.0, -end, -end + 1e-9, 0.0, end - 1e-9, end, 9.0]
    kept = hysteresis_branch(displacements, branch, START, LENGTH).eval()
    np.testing.assert_array_equal(kept, [1.0, 1.0, branch, branch, branch, -1.0, -1.0])


def test_remembered_force_is_continuous_and_takes_out_full_loops_only():
    """Along small swings, then once around: the work of the force is the area of one loop."""
    z, b = pt.dscalar("z"), pt.dscalar("b")
    force = hysteresis(z, b, STIFFNESS, START, LENGTH)
    kept = hysteresis_branch(z, b, START, LENGTH)
    step = pytensor.function([z, b], [force, kept], mode=AS_IT_STANDS)
    end, density = START + LENGTH, 200
    turns = np.array([0.0, 0.8, -0.7, 0.9, -end - 0.5, end + 0.5, 0.0]) * density
    path = np.concatenate([np.arange(a, o, np.sign(o - a)) for a, o in itertools.pairwise(turns)])
    path, branch, forces = path / density, 1.0, []
    for place in path:
        value, branch = step(place, branch)
        forces.append(float(value))
    assert np.abs(np.diff(forces)).max() <= STIFFNESS / density * (1 + 1e-9)
    assert branch == -1.0
    # The way back from 0 on the falling branch to 0 on the rising one closes the loop.
    f_0 = STIFFNESS * (2 * START + LENGTH) / 2
    down = np.linspace(0, -end, 2001)
    back = np.concatenate([down, down[::-1]])
    branches = np.repeat([-1.0, 1.0], 2001)
    closing = hysteresis(back, branches, STIFFNESS, START, LENGTH).eval()
    work = np.trapezoid(forces, path) + np.trapezoid(closing, back)
    assert work == pytest.approx(2 * f_0 * LENGTH, rel=1e-2)


@pytest.mark.parametrize("width", [None, *WIDTHS])
def test_forces_are_continuous_and_never_steeper_than_their_stiffness(force, width):
    slopes = np.diff(force(GRID, width)) / np.diff(GRID)
    assert slopes.max() <= STIFFNESS * (1 + 1e-9)
    assert slopes.min() >= -1e-9


@pytest.mark.parametrize("width", WIDTHS)
def test_smooth_forces_keep_their_stated_bound_and_reach_it(force, width):
    error = np.abs(force(GRID, width) - force(GRID))
    bound = 3 / 32 * STIFFNESS * width
    assert error.max() <= bound * (1 + 1e-9)
    if width < 2 * GAP:  # no overlap: the bound is met at a kink
        assert error.max() == pytest.approx(bound, rel=1e-9)


def test_smooth_forces_are_exact_away_from_their_kinks(force):
    kinks = [GAP, START, START + LENGTH]
    distance = np.min([np.abs(np.abs(GRID) - kink) for kink in kinks], axis=0)
    away = distance > 0.15
    np.testing.assert_allclose(force(GRID, 0.3)[away], force(GRID)[away], atol=1e-14)


def test_smooth_forces_have_two_continuous_derivatives(force):
    grid = np.linspace(-1.5, 1.5, 30_001)
    first, second = force(grid, 0.3, order=1), force(grid, 0.3, order=2)
    central = np.gradient(force(grid, 0.3), grid)
    np.testing.assert_allclose(first[1:-1], central[1:-1], atol=1e-5)
    # The third derivative is at most 6 k / width^2: a jump of the second would stand out.
    assert np.abs(np.diff(first)).max() <= 1.5 * STIFFNESS / 0.3 * 1.1e-4
    assert np.abs(np.diff(second)).max() <= 6 * STIFFNESS / 0.3**2 * 1.1e-4


def test_every_parameter_has_a_gradient():
    names = ("z", "v", "k_h", "a_h", "delta_h")
    symbols = [pt.dscalar(name) for name in names]
    value = hysteresis(*symbols, width=0.3)
    gradients = pytensor.function(symbols, pytensor.grad(value, symbols), mode=AS_IT_STANDS)
    evaluate = pytensor.function(symbols, value, mode=AS_IT_STANDS)
    point, step = np.array([0.5, 1.0, STIFFNESS, START, LENGTH]), 1e-6
    central = [
        (evaluate(*(point + step * axis)) - evaluate(*(point - step * axis))) / (2 * step)
        for axis in np.eye(5)
    ]
    np.testing.assert_allclose(gradients(*point), central, atol=1e-8)
    assert central[1] == 0.0  # the velocity only chooses the branch


def test_plain_numbers_are_computed_in_double_precision():
    assert cubic(10, 1, 1).eval() == 1010.0  # as an 8-bit integer it would overflow
    assert freeplay(0.5, 2.0, 0.25).dtype == "float64"
    assert hysteresis(0.5, 1.0, 2.0, 0.25, 0.25, width=0.5).dtype == "float64"


@pytest.mark.parametrize("width", [0, -0.1, np.inf, np.nan, "wide"])
def test_a_width_that_is_no_length_is_refused(width):
    with pytest.raises(ModelError, match="width must be a positive, finite number or None, got"):
        freeplay(0.1, 1.0, 0.2, width=width)
    with pytest.raises(ModelError, match="width"):
        hysteresis(0.1, 1.0, 1.0, 0.2, 0.3, width=width)
