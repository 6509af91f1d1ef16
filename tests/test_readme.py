"""The README's code runs as it stands; the guide's is run by the build of the guide."""

import ast
import json
import re
from pathlib import Path

import pytest

# PyMC writes progress to the stderr of its import: imported in a test, to one that is closed later.
import pymc_statespace_filters  # noqa: F401

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
