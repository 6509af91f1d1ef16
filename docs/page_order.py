"""The order in which the pages are read, so that no process of the build waits for another.

Sphinx deals runs of neighbours in its list of pages to the processes. By name, all tutorials are
neighbours: one process would run most notebooks, and the others end minutes before it.
"""

import json
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.parallel import make_chunks


def spread_notebooks(
    app: Sphinx, env: BuildEnvironment, docnames: list[str]
) -> None:
    """Reorder the list in place: each run of neighbours has its share of long notebooks."""
    longest_first = sorted(
        docnames, key=lambda page: -_number_of_cells(env.doc2path(page))
    )
    runs = make_chunks(docnames, app.parallel)
    rows = sorted(
        (row, run)
        for run, pages in enumerate(runs)
        for row in range(len(pages))
    )
    dealt = sorted(
        (run, row, page)
        for (row, run), page in zip(rows, longest_first, strict=True)
    )
    docnames[:] = [page for _, _, page in dealt]


def _number_of_cells(page: Path) -> int:
    """Count the cells that run; their number grows with the time that a notebook takes."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        return sum(cell["cell_type"] == "code" for cell in cells)
    return text.count("{code-cell}")
