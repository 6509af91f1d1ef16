"""Numbers that others published, by the scripts of ``make published`` that take seconds."""

import subprocess
import sys
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.waiting import LIMIT

FOLDER = Path(__file__).parents[1] / "examples" / "published"


@pytest.fixture(autouse=True)
def scripts(monkeypatch):
    """As if Python had been started with a script of the folder."""
    monkeypatch.syspath_prepend(FOLDER)
    yield
    for path in FOLDER.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.mark.filterwarnings("ignore:BootstrapPF:pymc_statespace_filters.errors.FilterWarning")
@pytest.mark.parametrize(
    "name",
    [
        "ricker",
        pytest.param("blowflies", marks=pytest.mark.slow),
        pytest.param("armadillo", marks=pytest.mark.slow),
        pytest.param("kangaroos", marks=pytest.mark.slow),
        pytest.param("earthquakes", marks=pytest.mark.slow),
        pytest.param("growth", marks=pytest.mark.slow),
        pytest.param("neurons", marks=pytest.mark.slow),
        pytest.param("lorenz_63", marks=pytest.mark.slow),
        pytest.param("measles", marks=pytest.mark.slow),
        pytest.param("lynx_hare", marks=pytest.mark.slow),
    ],
)
def test_it_is_the_published_number(name):
    """Each z is below 3.2; a right implementation fails once in 700 numbers."""
    study = import_module(name).study()
    assert study.comparisons
    for comparison in study.comparisons:
        assert abs(comparison.z) < 3.2, comparison


def test_particles_agree_with_the_exact_value_of_ricker():
    """The mean likelihood of 200 runs; a right filter fails once in 700."""
    ricker = import_module("ricker")
    record = {"observed": ricker.COUNTS, "steps": range(len(ricker.COUNTS))}
    exact = psf.log_likelihood(ricker.ricker, psf.GridFilter(), ricker.TRUTH, **record).sum()
    found = psf.log_likelihood(
        ricker.ricker, psf.BootstrapPF(1000), ricker.TRUTH, **record, seed=range(200)
    ).sum(axis=-1)
    ratios = np.exp(found - exact)
    assert abs(ratios.mean() - 1.0) < 3.2 * ratios.std(ddof=1) / 200**0.5


def made_up(z, correlation=None):
    comparison = import_module("comparison")
    numbers = [comparison.Comparison("a number", 0.0, 1.0, value) for value in z]
    return comparison.Study("a study, of old", "nobody", numbers, 0.0, "", correlation)


def run_with(monkeypatch, study, names=("any",)):
    run = import_module("run")
    monkeypatch.setattr(run, "import_module", lambda name: type("m", (), {"study": lambda: study}))
    run.main(list(names))


@pytest.mark.parametrize("z", [1.0, 5.0])
def test_the_table_of_the_guide_has_only_numbers_that_hold(monkeypatch, tmp_path, z):
    table = tmp_path / "table.inc"
    monkeypatch.setattr(import_module("run"), "TABLE", table)
    with pytest.raises(SystemExit) if z > 3.0 else nullcontext():
        run_with(monkeypatch, made_up([z]), names=())
    assert table.exists() == (z < 3.0)


def test_a_script_that_was_copied_prints_its_comparison(tmp_path):
    """-250.62 is within 0.6 standard errors of both numbers that were published."""
    for part in ("kitagawa.py", "comparison.py", "data/kitagawa.csv"):
        (tmp_path / part).parent.mkdir(exist_ok=True)
        copy(FOLDER / part, tmp_path / part)
    command = [sys.executable, tmp_path / "kitagawa.py"]
    printed = subprocess.run(
        command, capture_output=True, timeout=LIMIT, text=True, check=True
    ).stdout
    assert "-250.62" in printed
    assert "errors by chance" not in printed  # too few numbers for a statement


def test_a_number_that_is_off_ends_the_run_with_its_name(monkeypatch):
    with pytest.raises(SystemExit, match=r"a study, of old: a number \(z = \+5\.00\)"):
        run_with(monkeypatch, made_up([5.0]))


@pytest.mark.parametrize("size", [0.05, 2.5])
def test_errors_that_are_too_large_or_too_small_end_the_run(monkeypatch, size):
    with pytest.raises(SystemExit, match=r"a study: mean z² = .* not in 0\.13 to 3\.14\nall: "):
        run_with(monkeypatch, made_up(size * np.tile([1.0, -1.0], 5)))


def test_numbers_that_depend_on_each_other_are_worth_fewer(monkeypatch):
    """Ten times one number, 2.5 standard errors off, is no surprise; nor is rounding."""
    run_with(monkeypatch, made_up(np.full(10, 2.5), np.ones((10, 10))))
    rounded = made_up(np.full(10, 0.05))
    rounded = rounded._replace(
        comparisons=[c._replace(by_chance=False) for c in rounded.comparisons]
    )
    run_with(monkeypatch, rounded)


def test_correlated_errors_scatter_as_their_interval_says():
    """Of 2000 two fall outside; eight do once in 10 000."""
    comparison = import_module("comparison")
    rng = np.random.default_rng(1)
    draws = rng.standard_normal((5000, 3)) @ [[1.0, 0.9, 0.9], [0.0, 0.4, 0.3], [0.0, 0.0, 0.3]]
    c = comparison.correlation_of_moments(draws.T)
    found = [
        comparison.spread("any", [made_up(z, c)])
        for z in rng.multivariate_normal(np.zeros(6), c, size=2000)
    ]
    assert np.mean([s.mean_square for s in found]) == pytest.approx(1.0, abs=0.1)
    outside = [not s.low <= s.mean_square <= s.high for s in found]
    assert 1.0 < found[0].worth < 6.0
    assert sum(outside) < 8


def test_moments_of_draws_are_their_own():
    """Draws beside themselves are zero standard errors off; another's mean is not."""
    comparison = import_module("comparison")
    x = np.random.default_rng(2).standard_normal((4, 1000))
    mean, sd = comparison.moments("x", x, x.mean(), x.std(), 1000)
    assert mean.z == sd.z == 0.0
    assert mean.published_error == pytest.approx(2.0 * mean.our_error, rel=0.1)
    assert sd.published_error == pytest.approx(2.0 * sd.our_error, rel=0.1)
