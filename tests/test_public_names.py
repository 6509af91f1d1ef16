"""Public names: documented, listed in the reference, and moved with a word."""

import doctest
import inspect
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from operator import attrgetter
from pathlib import Path

import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.former_names import NAMES
from tests.waiting import LIMIT

PACKAGE = psf.__name__


def load(path):
    spec = spec_from_file_location(path.stem, path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGES = load(Path(__file__).parents[1] / "docs" / "reference_pages.py")
LISTED = [name for names in PAGES.GROUPS.values() for name in names]


def test_the_reference_lists_every_public_name_once():
    assert len(LISTED) == len(set(LISTED))
    # Results have a page, though nobody constructs them.
    assert set(LISTED) - PAGES.public_names() == {
        "evidence.Evidence",
        "point_estimation.MaximumLikelihoodEstimate",
        # Few need these: they have no name at the top.
        "diagnostics.drift_scan",
        "system.stationary",
    }
    assert PAGES.public_names() <= set(LISTED)


@pytest.mark.parametrize("name", sorted(PAGES.public_names()))
def test_every_public_name_is_documented_with_an_example(name):
    text = inspect.getdoc(attrgetter(name)(psf))
    assert "Examples\n-------" in text
    examples = doctest.DocTestParser().get_examples(text)
    run = [one for one in examples if doctest.SKIP not in one.options]
    # Those that import something only show nothing; `--doctest-modules` runs them all.
    assert any("import" not in one.source for one in run)


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("cubic", "mechanics"),
        ("gamma_white_noise", "compartments"),
        ("ModelError", "errors"),
        ("Evidence", "evidence"),
        ("MaximumLikelihoodEstimate", "point_estimation"),
        ("drift_scan", "diagnostics"),
        ("stationary", "system"),
    ],
)
def test_a_moved_name_says_where_it_went(name, place):
    message = rf"^{PACKAGE}\.{name} has moved to {PACKAGE}\.{place}\.{name}\.$"
    with pytest.raises(AttributeError, match=message):
        getattr(psf, name)
    with pytest.raises(ImportError, match=message):
        exec(f"from {PACKAGE} import {name}")
    exec(f"from {PACKAGE}.{place} import {name}")
    assert not hasattr(psf, name)


def test_an_old_name_is_none_of_today():
    assert not NAMES.keys() & set(psf.__all__)


def test_a_place_is_there_before_anything_of_it_is_used():
    script = f"import {PACKAGE} as psf; psf.diagnostics.drift_scan, psf.system.stationary"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=LIMIT)


def test_an_unknown_name_is_unknown():
    with pytest.raises(AttributeError, match="kalman"):
        _ = psf.kalman
    with pytest.raises(ImportError, match="kalman"):
        exec(f"from {PACKAGE} import kalman")
