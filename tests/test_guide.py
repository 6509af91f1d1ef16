"""The build of the guide: which notebooks run, and what becomes of one that fails."""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from tests.waiting import LIMIT

# The newest releases are tested without those of the guide.
pytest.importorskip("myst_nb")
pytest.importorskip("math_core")
nodes = pytest.importorskip("docutils.nodes")

ROOT = Path(__file__).parents[1]
CONF = """
import sys
from pathlib import Path
sys.path.insert(0, {docs!r})
import notebook_cache
HERE = Path(__file__).parent
extensions = ["myst_nb"]
exclude_patterns = [".cache"]
nb_execution_mode = "cache"
nb_execution_raise_on_error = False
nb_execution_cache_path = str(notebook_cache.folder(HERE))
def setup(app):
    notebook_cache.prepare(Path(nb_execution_cache_path))
    app.connect("build-finished", notebook_cache.report_failures)
"""


def write_notebook(path, source):
    cells = [
        {"cell_type": "markdown", "metadata": {}, "source": f"# {path.stem}"},
        {"cell_type": "code", "metadata": {}, "source": source, "outputs": []},
    ]
    cells[1]["execution_count"] = None
    spec = {"name": "python3", "display_name": "Python 3", "language": "python"}
    book = {"cells": cells, "metadata": {"kernelspec": spec}, "nbformat": 4, "nbformat_minor": 4}
    path.write_text(json.dumps(book))


@pytest.fixture(scope="module")
def guide(tmp_path_factory):
    """A guide with a package of one file, a notebook that counts its runs and one that fails."""
    guide = tmp_path_factory.mktemp("build") / "guide"
    package = guide / "pymc_statespace_filters"
    package.mkdir(parents=True)
    (package / "sources.py").write_text("number = 1\n")
    (guide / "conf.py").write_text(CONF.format(docs=str(ROOT / "docs")))
    (guide / "index.md").write_text("# Guide\n\n```{toctree}\ngood\nbad\n```\n")
    write_notebook(guide / "good.ipynb", f"print('ran', file=open({str(guide / 'runs')!r}, 'a'))")
    write_notebook(guide / "bad.ipynb", "1 / 0")
    return guide


def build(guide):
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-E",
        "-W",
        "--keep-going",
        "--quiet",
        "--no-color",
        "-b",
        "html",
    ]
    return subprocess.run(
        [*command, str(guide), str(guide.parent / "html")],
        capture_output=True,
        timeout=LIMIT,
        text=True,
    )


@pytest.fixture(scope="module")
def first(guide):
    return build(guide)


def test_a_notebook_that_fails_is_named_at_the_end_and_the_other_pages_are_written(guide, first):
    assert first.returncode == 1
    lines = first.stderr.strip().splitlines()
    assert lines[-1] == (
        "WARNING: the notebooks of these pages failed: bad (CellExecutionError). All other pages "
        "are complete."
    )
    for page in ("index", "good", "bad"):
        assert (guide.parent / "html" / f"{page}.html").exists()
    assert "IPKernelApp" not in first.stderr


def test_notebooks_run_again_if_they_or_the_package_have_changed(guide, first, monkeypatch):
    write_notebook(guide / "bad.ipynb", "1 / 1")
    assert build(guide).returncode == 0
    assert (guide / "runs").read_text() == "ran\n"
    (old,) = (guide / ".cache" / "notebooks").iterdir()
    monkeypatch.syspath_prepend(ROOT / "docs")
    notebook_cache = import_module("notebook_cache")
    monkeypatch.setattr(notebook_cache, "get_cache", lambda new: SimpleNamespace(db=new.mkdir()))
    monkeypatch.setenv("IPYTHONDIR", "")  # which the build sets
    assert notebook_cache.folder(guide) == old
    (guide / "pymc_statespace_filters" / "sources.py").write_text("number = 2\n")
    new = notebook_cache.folder(guide)
    notebook_cache.prepare(new)  # a cache in which nothing has run yet
    assert list((guide / ".cache" / "notebooks").iterdir()) == [new]


@pytest.mark.parametrize("displayed", [False, True])
def test_formulas_are_mathml_or_a_warning(displayed, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    mathml = import_module("mathml")
    log = Mock()
    monkeypatch.setattr(mathml, "LOG", log)
    text = r"a &= \frac12 \\ b &= 2" if displayed else r"\frac12"
    found = mathml.markup(nodes.math(text, text), displayed=displayed)
    assert found.startswith("<math")
    assert "<mn>1</mn><mn>2</mn></mfrac>" in found
    assert found.count("<mtr>") == 2 * displayed
    log.warning.assert_not_called()
    wrong = nodes.math("", r"\wrong<")
    assert mathml.markup(wrong, displayed=displayed) == r"<code>\wrong&lt;</code>"
    log.warning.assert_called_once()


def test_pages_with_pictures_have_one_style():
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")]
    texts = {page.name: page.read_text().replace("\\", "") for page in pages}
    drawn = [n for n, text in texts.items() if "import pymc" in text and "plot_" in text]
    assert len(drawn) > 10
    assert [name for name in drawn if 'az.style.use("arviz-variat")' not in texts[name]] == []


def test_pages_that_show_the_machine_are_named(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    local_traces = import_module("local_traces")
    (tmp_path / "howto").mkdir()
    (tmp_path / "index.html").write_text("<p>Nothing of it</p>")
    (tmp_path / "howto" / "bad.html").write_text(
        "<pre>/home/me/lib/site-packages/rich/live.py:260: UserWarning: install ipywidgets</pre>"
    )
    traces = ("/home/me", "/other", *local_traces.TRACES)
    assert list(local_traces.found(tmp_path, traces)) == [
        ("howto/bad.html", ["/home/me", "site-packages", "ipywidgets"])
    ]


def test_each_process_has_its_share_of_the_notebooks(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    page_order = import_module("page_order")
    cells = {f"page_{i:03}": 0 for i in range(130)} | {f"tutorial_{i}": 3 * i for i in range(8)}
    for page, n in cells.items():
        (tmp_path / page).write_text("```{code-cell}\n```\n" * n)
    pages = sorted(cells)
    app, env = SimpleNamespace(parallel=2), SimpleNamespace(doc2path=tmp_path.joinpath)
    page_order.spread_notebooks(app, env, pages)
    assert sorted(pages) == sorted(cells)
    of_runs = [sum(map(cells.get, run)) for run in page_order.make_chunks(pages, app.parallel)]
    assert len(of_runs) > 2
    assert max(of_runs) - min(of_runs) <= max(cells.values())
