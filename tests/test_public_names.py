"""Public names: documented, listed in the reference, and moved with a word."""

import ast
import doctest
import inspect
import json
import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from operator import attrgetter
from pathlib import Path

import pytest

# PyMC writes progress to the stderr of its import: imported in a test, to one that is closed later.
import pymc_statespace_filters  # noqa: F401
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


# The README's code runs as it stands; the guide's is run by the build of the guide.


ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted(path for path in (ROOT / "docs").rglob("*.ipynb") if "_build" not in path.parts)


def cells_of(notebook: Path) -> list[dict]:
    return [
        c
        for c in json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        if c["cell_type"] == "code"
    ]


def code_of(page: str) -> str:
    return "\n".join(
        re.findall(
            r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL
        )
    )


def run_code_of(*pages: str) -> dict:
    """Run the code of pages in their order, a later one with the names of those before."""
    names: dict = {}
    for page in pages:
        exec(compile(code_of(page), page, "exec"), names)
    return names


def test_the_example(capsys: pytest.CaptureFixture) -> None:
    """Thirteen statements, and the probability that the text tells."""
    names = run_code_of("README.md")
    statements = [n for n in ast.walk(ast.parse(code_of("README.md"))) if isinstance(n, ast.stmt)]
    assert len(statements) == 13
    assert list(names["fits"]) == ["one well", "two wells"]
    rows = capsys.readouterr().out.splitlines()
    (probability,) = (row.split()[2] for row in rows if row.startswith("two wells"))
    assert f"probability of {float(probability) * 100:.0f} %" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_kept_without_outputs(notebook: Path) -> None:
    kernel = json.loads(notebook.read_text(encoding="utf-8"))["metadata"]["kernelspec"]["name"]
    assert kernel == "python3"  # that of any Jupyter
    for cell in cells_of(notebook):
        assert not cell["outputs"]
        assert cell["execution_count"] is None
