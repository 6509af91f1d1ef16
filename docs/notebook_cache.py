"""Outputs of the guide's notebooks, kept while what they depend on is the same.

myst-nb compares the cells of a notebook with those of the cache. Here the folder of the cache is
named after everything else: the sources of the package, the records that notebooks read, and the
versions of the dependencies.
"""

import hashlib
import os
import shutil
from pathlib import Path

import matplotlib.font_manager  # noqa: F401 - lists the fonts, once for all kernels: a slow list is a warning
from docutils import nodes
from jupyter_cache import get_cache
from sphinx.application import Sphinx
from sphinx.util import logging

SOURCES = (
    "pymc_statespace_filters/**/*.py",
    "docs/**/*.csv",
    "docs/_static/matplotlibrc",
    "requirements.lock",
)


def folder(root: Path) -> Path:
    """Name the cache in a repository, by a digest of the sources."""
    digest = hashlib.sha256()
    for pattern in SOURCES:
        for path in sorted(root.glob(pattern)):
            digest.update(f"{path.relative_to(root)}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return root / ".cache" / "notebooks" / digest.hexdigest()[:16]


def prepare(cache: Path) -> None:
    """Make the cache before two processes use it, and remove those of other sources."""
    for other in cache.parent.glob("*"):
        if other != cache and other.is_dir():
            shutil.rmtree(other)
    get_cache(cache).db  # noqa: B018 - reading it makes its tables
    _set_up_kernels(cache.parent.with_name("ipython"))


def _set_up_kernels(profiles: Path) -> None:
    """Have kernels write errors only, and collect garbage less often.

    Each warns that it is reached by TCP, the default. Compilation makes millions of objects that
    stay, which the collector would visit over and over. What is said where it takes seconds would
    depend on the machine.
    """
    config = profiles / "profile_default" / "ipython_kernel_config.py"
    config.parent.mkdir(parents=True, exist_ok=True)
    config.write_text(
        "import gc\n"
        "from pymc_statespace_filters import progress\n"
        "gc.set_threshold(50_000, 20, 10)\n"
        "progress.PATIENCE = 3600.0\n"
        'get_config().IPKernelApp.log_level = "ERROR"\n',
        encoding="utf-8",
    )
    os.environ["IPYTHONDIR"] = str(profiles)


def report_stderr(app: Sphinx, page: nodes.document) -> None:
    """Warn of what a cell wrote to its stderr, unless its page says what to do with it."""
    for cell in page.findall(
        lambda node: "cell_metadata" in getattr(node, "attributes", ())
    ):
        if "output_stderr" in cell["cell_metadata"].get("mystnb", {}):
            continue
        for output in cell.findall(nodes.literal_block):
            if "stderr" in output["classes"]:
                logging.getLogger(__name__).warning(
                    "cell %d wrote to its stderr: %s",
                    cell["cell_index"],
                    output.astext(),
                    location=app.env.docname,
                )


def report_failures(app: Sphinx, exception: Exception | None) -> None:
    """Name the pages whose notebooks failed, after all messages of the build."""
    pages = getattr(app.env, "nb_metadata", {})
    failed = [
        f"{page} ({ran['error']})"
        for page, of_page in sorted(pages.items())
        if (ran := of_page.get("exec_data")) and not ran["succeeded"]
    ]
    if failed:
        logging.getLogger(__name__).warning(
            "the notebooks of these pages failed: %s. All other pages are complete.",
            ", ".join(failed),
        )
