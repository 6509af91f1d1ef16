"""Built pages that show the machine which built them, or need another server to be shown."""

import sys
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util import logging

# What paths of packages and cells contain, warnings of packages that a notebook lacks, and scripts
# and pictures of other servers.
TRACES = (
    "site-packages",
    "ipykernel_",
    "ipywidgets",
    "IProgress",
    'src="http',
)


def report(app: Sphinx, exception: Exception | None) -> None:
    """Name the pages with such traces; a warning, which fails a build with ``-W``."""
    if exception is not None or app.builder.format != "html":
        return
    own = (str(Path(app.srcdir).parent), sys.prefix)
    for page, traces in found(Path(app.outdir), (*own, *TRACES)):
        logging.getLogger(__name__).warning(
            "%s shows the machine that built it, or needs another: %s",
            page,
            ", ".join(traces),
        )


def found(
    folder: Path, traces: tuple[str, ...]
) -> Iterator[tuple[str, list[str]]]:
    """Pages of a folder, each with those of the traces that it shows."""
    for path in sorted(folder.rglob("*.html")):
        text = path.read_text(encoding="utf-8")
        if shown := [trace for trace in traces if trace in text]:
            yield str(path.relative_to(folder)), shown
