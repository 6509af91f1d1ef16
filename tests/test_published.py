"""Numbers that others published, by the scripts of ``make published`` that take seconds."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import pymc_statespace_filters as psf

FOLDER = Path(__file__).parents[1] / "examples" / "published"


@pytest.fixture(autouse=True)
def scripts(monkeypatch):
    """As if Python had been started with a script of the folder."""
    monkeypatch.syspath_prepend(FOLDER)
    yield
    for path in FOLDER.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.mark.filterwarnings("ignore:BootstrapPF:pymc_statespace_filters.FilterWarning")
@pytest.mark.parametrize(
    "name",
    [
        "kitagawa",
        "ricker",
        "blowflies",
        "kangaroos",
        pytest.param("neurons", marks=pytest.mark.slow),
        pytest.param("lorenz_63", marks=pytest.mark.slow),
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


def test_a_number_that_is_off_ends_the_run_with_its_name(monkeypatch):
    comparison, run = import_module("comparison"), import_module("run")
    wrong = comparison.Comparison("a number", 1.0, 0.1, 1.5)
    study = comparison.Study("a study", "nobody", [wrong], 0.0, "")
    monkeypatch.setattr(run, "import_module", lambda name: type("m", (), {"study": lambda: study}))
    with pytest.raises(SystemExit, match=r"a study: a number \(z = \+5\.00\)"):
        run.main(["any"])
