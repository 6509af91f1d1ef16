"""BootstrapPF against the same equations in NumPy, and unbiased against the exact likelihood."""

import numpy as np
import pytest
from scipy.special import logsumexp

from pymc_statespace_filters.compiler.numerics.normals import uniform
from pymc_statespace_filters.compiler.numerics.philox import RESAMPLING
from pymc_statespace_filters.filters.bootstrap import BootstrapPF
from tests.filters.ensemble_contract import (
    LINE,
    OSCILLATOR,
    EnsembleFilterContract,
    forecasts,
    kalman,
    linear,
    log_gaussian,
    normals,
    run,
    stored_noise,
)


class TestBootstrapPF(EnsembleFilterContract):
    @pytest.fixture
    def filter_(self):
        return BootstrapPF(200)


def numpy_bootstrap(system, steps, observed, n_particles, seed, resample_below):
    """Eqs. 4.28 and 4.43 with systematic resampling in NumPy; also the smallest N_eff."""
    H, R = system.C, system.R
    X, terms, smallest = None, [], float(n_particles)
    w = np.full(n_particles, 1 / n_particles)
    for step, (start, advance, _), d in zip(
        steps, forecasts(system, n_particles, steps, seed), observed, strict=True
    ):
        X = advance(start if X is None else X)
        seen = ~np.isnan(d)
        if not seen.any():
            terms.append(0.0)
            continue
        log_w = np.log(w) + log_gaussian((d[:, None] - H @ X)[seen], np.diag(R)[seen])
        terms.append(logsumexp(log_w))
        w = np.exp(log_w - terms[-1])
        n_effective = 1 / np.sum(w**2)
        smallest = min(smallest, n_effective)
        if n_effective < resample_below * n_particles:
            points = (
                np.arange(n_particles) + uniform(*normals(seed, RESAMPLING, step, (1, 2))[0])
            ) / n_particles
            X = X[:, np.searchsorted(np.cumsum(w), points, side="right")]
            w = np.full(n_particles, 1 / n_particles)
    return np.array(terms), smallest


@pytest.mark.parametrize("resample_below", [0, 1 / 3, 1])
def test_is_its_equations_written_in_numpy(resample_below):
    filter_ = BootstrapPF(200, resample_below=resample_below)
    for seed in range(3):
        expected, smallest = numpy_bootstrap(*OSCILLATOR, 200, seed, resample_below)
        terms, health = run(filter_, *OSCILLATOR, seed=seed)
        assert terms == pytest.approx(expected, rel=1e-9)
        assert health == pytest.approx([smallest, 0, -1])


@pytest.mark.parametrize(
    ("resampling", "resample_below"), [("systematic", 1 / 3), ("multinomial", 1), ("systematic", 0)]
)
def test_the_mean_of_the_likelihood_is_the_exact_one(resampling, resample_below):
    filter_ = BootstrapPF(50, resample_below=resample_below, resampling=resampling)
    exact = kalman(*LINE).sum()
    logs = np.array([run(filter_, *LINE, seed=s)[0].sum() for s in range(3000)])
    ratio = np.exp(logs - exact)
    assert logs.var() < 2
    # 3.5 standard errors: one false alarm in 2000 seeds, three cases
    assert abs(ratio.mean() - 1) < 3.5 * ratio.std() / np.sqrt(ratio.size)


def test_resampling_at_every_observation_holds_for_equal_weights_too():
    # The first observable does not see the state, so the weights stay equal and N_eff = N exactly;
    # multinomial resampling shows in what the second observable then finds
    blind_first = linear([[1.0]], [[0.5]], [[0.0], [1.0]], np.eye(2), [0.0], [[1.0]])
    record = (blind_first, [0, 1], np.array([[1.0, np.nan], [np.nan, 1.0]]))
    always, never = (
        run(BootstrapPF(64, resample_below=fraction, resampling="multinomial"), *record)
        for fraction in (1, 0)
    )
    assert always[0][0] == never[0][0]
    assert always[0][1] != never[0][1]


def test_stored_normals_serve_multinomial_resampling_too():
    filter_ = BootstrapPF(50, resampling="multinomial", resample_below=1)
    stored = stored_noise(filter_, *LINE[:2], 7)
    by_seed, _ = run(filter_, *LINE, seed=7)
    by_normals, _ = run(filter_, *LINE, normals=stored)
    assert np.array_equal(by_seed, by_normals)


def test_sorted_resampling_of_two_states_is_unbiased():
    system, steps, observed = OSCILLATOR
    steps, observed = steps[:6], observed[:6]
    filter_ = BootstrapPF(80, resample_below=1, resampling="sorted")
    exact = kalman(system, steps, observed).sum()
    logs = np.array([run(filter_, system, steps, observed, seed=s)[0].sum() for s in range(4000)])
    ratio = np.exp(logs - exact)
    assert 0.05 < logs.var() < 2
    # 3.5 standard errors: one false alarm in 2000 seeds
    assert abs(ratio.mean() - 1) < 3.5 * ratio.std() / np.sqrt(ratio.size)


def moves(filter_, record, correlation, n_pairs):
    """Variances of log L and of its difference to log L after the normals have moved."""
    logs = np.empty((n_pairs, 2))
    for pair in range(n_pairs):
        u, v = (stored_noise(filter_, *record[:2], 2 * pair + i) for i in (0, 1))
        moved = correlation * u + np.sqrt(1 - correlation**2) * v
        for i, z in enumerate((u, moved)):
            logs[pair, i] = run(filter_, *record, normals=z)[0].sum()
    return logs[:, 0].var(), np.diff(logs).var()


@pytest.mark.parametrize(("record", "least"), [(LINE, 6), (OSCILLATOR, 1.5)])
def test_sorted_resampling_is_smooth_in_the_normals(record, least):
    """Variances of 200 differences: a ratio of two of them has a relative error of a seventh."""
    sorted_, systematic = (
        moves(BootstrapPF(200, resample_below=1, resampling=scheme), record, 0.9999, 200)
        for scheme in ("sorted", "systematic")
    )
    assert least * sorted_[1] < systematic[1]
    assert sorted_[0] == pytest.approx(systematic[0], rel=0.6)  # as noisy, but moving less
