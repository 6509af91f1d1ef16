"""Records without a density are refused, and no others."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.evaluation.exact_rows import check_exact_rows
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.record import read_record
from pymc_statespace_filters.testing import kalman_log_likelihood

DT, STIFFNESS, DAMPING = 0.05, 2.0, 0.3
START = np.diag([0.1, 0.1])
BOTH, NO_NOISE = np.eye(2), np.zeros((2, 2))


def oscillator(seen=BOTH, noise=NO_NOISE, diffusion=lambda s: [[0.0], [s]], cov=START, **settings):
    """Its velocity alone is pushed, unless another ``diffusion`` is given."""

    def drift(x, k=STIFFNESS):
        return [x[1], -k * x[0] - DAMPING * x[1]]

    return psf.StateSpaceModel(
        psf.EulerMaruyama(drift, diffusion, dt=DT, **settings),
        observation=lambda x: np.asarray(seen) @ x,
        observation_noise=noise,
        initial_mean=[1.0, 0.0],
        initial_cov=cov,
    )


def record(steps, seen=BOTH):
    states = psf.simulate(oscillator(), {"s": 0.5}, steps=steps, random_seed=1)["observations"]
    return states.values @ np.transpose(seen)


def exact_terms(steps, observed, s, seen=BOTH, noise=NO_NOISE, gain=((0.0,), (1.0,)), n_parts=1):
    """Terms of the oscillator's linear steps, each in so many parts."""
    h = DT / n_parts
    A = np.array([[1.0, h], [-h * STIFFNESS, 1.0 - h * DAMPING]])
    Q = s**2 * h * np.asarray(gain) @ np.transpose(gain)
    return kalman_log_likelihood(
        A, Q, seen, noise, [1.0, 0.0], START, steps=n_parts * np.asarray(steps), observed=observed
    )


EVERY = np.arange(1, 201)
LOST = "stochastic singularity in row 1, at step 2: the sensors without noise, y0, y1, fix 2 numb"


def test_two_exact_sensors_and_one_shock_are_refused_at_every_door():
    """The log-likelihood was -inf, 57 and -inf by rounding, at s = .3, .35 and .4."""
    observed, point = record(EVERY), {"s": 0.5}
    with pytest.raises(psf.errors.ModelError, match=LOST):
        psf.log_likelihood(oscillator(), psf.EKF(), point, observed, steps=EVERY)
    with pytest.raises(psf.errors.ModelError, match=LOST):
        psf.run_filter(oscillator(), psf.UKF(), point, observed, steps=EVERY)
    with pm.Model():
        pm.HalfNormal("s", 1.0)
        for data in (observed, pm.Data("data", observed)):
            with pytest.raises(psf.errors.ModelError, match=LOST):
                psf.StateSpace("d", oscillator(), psf.EKF(), steps=EVERY, observed=data)
        psf.StateSpace("simulated", oscillator(), psf.EKF(), steps=EVERY)


@pytest.mark.parametrize(
    ("lost", "noise"),
    [([0], NO_NOISE), ([1], NO_NOISE), ([], 1e-4 * np.eye(2)), ([], np.diag([1e-4, 0.0]))],
    ids=["no position", "no velocity", "noise", "noise of one"],
)
def test_the_advice_finds_the_noise_that_the_record_was_made_with(lost, noise):
    observed = record(EVERY)
    observed[:, lost] = np.nan
    sizes = np.arange(0.3, 0.75, 0.05)
    system = oscillator(noise=noise)
    found = psf.log_likelihood(system, psf.EKF(), {"s": sizes}, observed, steps=EVERY)
    exact = [exact_terms(EVERY, observed, s, noise=noise) for s in sizes]
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6)
    assert 0.45 <= sizes[found.sum(axis=1).argmax()] <= 0.55


def test_more_shocks_are_a_way_out():
    observed, pushed = record(EVERY), oscillator(diffusion=lambda s: [[s, 0.0], [0.0, s]])
    found = psf.log_likelihood(pushed, psf.EKF(), {"s": 0.5}, observed, steps=EVERY)
    np.testing.assert_allclose(found, exact_terms(EVERY, observed, 0.5, gain=BOTH), rtol=1e-6)


def test_records_with_a_density_are_taken():
    """One exact sensor, gaps of two steps, empty and partly missing rows, steps in parts."""
    wide, at_twenty, point = np.arange(0, 41, 2), np.arange(1, 21), {"s": 0.5}
    position = [[1.0, 0.0]]
    cases = [(at_twenty, record(at_twenty, position), position), (wide, record(wide), BOTH)]
    gaps = record(at_twenty)
    gaps[1::2] = np.nan
    cases.append((at_twenty, gaps, BOTH))
    turns = record(at_twenty)
    turns[1::2, 0] = turns[::2, 1] = np.nan
    cases.append((at_twenty, turns, BOTH))
    for steps, observed, seen in cases:
        found = psf.log_likelihood(oscillator(seen, np.zeros((len(seen),) * 2)), psf.EKF(), point,
                                   observed, steps=steps)  # fmt: skip
        noise = np.zeros((len(seen),) * 2)
        exact = exact_terms(steps, observed, 0.5, seen, noise)
        np.testing.assert_allclose(found, exact, rtol=1e-6)
    both, parts = record(at_twenty), oscillator(substeps=2)
    found = psf.log_likelihood(parts, psf.EKF(), point, both, steps=at_twenty)
    np.testing.assert_allclose(found, exact_terms(at_twenty, both, 0.5, n_parts=2), rtol=1e-6)


def test_each_record_of_a_panel_begins_anew():
    steps, panel = np.concatenate([[1, 3], [1, 3]]), ["a", "a", "b", "b"]
    observed = np.concatenate([record([1, 3]), record([1, 3])])
    found = psf.log_likelihood(
        oscillator(), psf.EKF(), {"s": 0.5}, observed, steps=steps, panel=panel
    )
    np.testing.assert_allclose(found[2:], exact_terms([1, 3], observed[2:], 0.5), rtol=1e-6)
    with pytest.raises(psf.errors.ModelError, match="in row 3 of the record 'b', at step 2:"):
        psf.log_likelihood(
            oscillator(), psf.EKF(), {"s": 0.5}, observed, steps=[1, 3, 1, 2], panel=panel
        )


def test_a_known_start_that_is_seen_exactly_is_refused():
    known, point = oscillator([[1.0, 0.0]], [[0.0]], cov=NO_NOISE), {"s": 0.5}
    with pytest.raises(psf.errors.ModelError, match="y0, fix 1 number, and at most 0 can vary"):
        psf.log_likelihood(known, psf.EKF(), point, [1.0, 1.1], steps=[0, 2])
    found = psf.log_likelihood(known, psf.EKF(), point, [np.nan, 1.0], steps=[0, 2])
    sd = 0.5 * DT**1.5
    mean = 1.0 - DT**2 * STIFFNESS
    exact = -0.5 * ((1.0 - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2.0 * np.pi)
    np.testing.assert_allclose(found, [0.0, exact], rtol=1e-6)


@pytest.mark.parametrize("seed", range(200))
def test_refused_is_what_has_a_singular_joint_covariance(seed):
    """Of random dense systems the count is exact: data = M z with z standard normals."""
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers([1, 1, 1], [4, 3, 4])
    A, B, C = (rng.normal(size=size) for size in ((n, n), (n, m), (p, n)))
    start = np.diag(rng.integers(0, 2, n).astype(float))
    steps = np.cumsum(rng.integers(1, 4, 5)) - 1
    observed = np.where(rng.random((5, p)) < 0.4, np.nan, 0.0)
    exact = rng.random(p) < 0.8
    system = psf.StateSpaceModel(
        lambda x, q: A @ x + B @ q,
        process_noise=np.eye(m),
        observation=lambda x: C @ x,
        observation_noise=np.diag(np.where(exact, 0.0, 1.0)),
        initial_mean=np.zeros(n),
        initial_cov=start,
    )
    state, rows = np.zeros((n, n + m * steps[-1])), []
    state[:, :n] = start
    for step in range(steps[-1] + 1):
        if step:
            state = A @ state
            state[:, n + m * (step - 1) : n + m * step] = B
        if step in steps:
            rows.extend(C[exact & ~np.isnan(observed[steps == step][0])] @ state)
    has_density = not rows or np.linalg.matrix_rank(rows, tol=1e-9) == len(rows)
    record = read_record(system, GivenRecord(observed, steps=steps))
    if has_density:
        check_exact_rows(record)
    else:
        with pytest.raises(psf.errors.ModelError, match="stochastic singularity"):
            check_exact_rows(record)
