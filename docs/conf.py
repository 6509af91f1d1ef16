"""Sphinx settings."""

import os
import sys
from importlib.metadata import version as installed_version
from inspect import signature
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from pymc_statespace_filters import DRAM  # noqa: E402

import local_traces  # noqa: E402
import notebook_cache  # noqa: E402
import page_order  # noqa: E402
import reference_pages  # noqa: E402

project = "pymc-statespace-filters"
author = "The pymc-statespace-filters developers"
release = version = installed_version(project)

extensions = [
    "gallery",  # docs/gallery.py
    "mathml",  # docs/mathml.py
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
]
# The notes of the studies are included in the page on the thesis.
exclude_patterns = ["_build", "thesis/*/*.md"]
nitpicky = True  # every reference within the guide must be found
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

# Notebooks are stored without outputs. A notebook runs once for each version of the package, and in
# every build of .ci/run. One that raises, takes too long, or writes a warning to its stderr fails the
# build at its end, when the other pages are written.
nb_execution_mode = "cache"
nb_execution_cache_path = str(notebook_cache.folder(HERE.parent))
nb_execution_raise_on_error = False
nb_execution_timeout = 240
nb_merge_streams = True
nb_output_stderr = "show"  # and `report_stderr` warns, with the text
os.environ["MATPLOTLIBRC"] = str(HERE / "_static" / "matplotlibrc")

# The reference is the list of public names in __init__.py.
autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and types
numpydoc_show_class_members = False
# Sphinx would show the signature of PyMC's __new__ for step methods: (*args, **kwargs).
DRAM.__signature__ = signature(DRAM)

copybutton_exclude = ".linenos, .gp, .go"

html_theme = (
    "pydata_sphinx_theme"  # the theme of PyMC's own pages derives from it
)
html_title = "pymc-statespace-filters"
html_static_path = ["_static"]
html_css_files = ["guide.css"]
html_math_renderer = "mathml"
html_sidebars = {"index": [], "start": [], "thesis": []}
html_show_sourcelink = False
html_theme_options = {
    "footer_end": [],
    "footer_start": ["copyright"],
    "header_links_before_dropdown": 6,
    "navbar_end": ["theme-switcher"],
    # A field would wrap the header at 1280 px.
    "navbar_persistent": ["search-button"],
    "secondary_sidebar_items": {"**": ["page-toc"], "index": []},
    "show_nav_level": 2,
}

# For `make linkcheck`, which needs network access.
linkcheck_timeout = 20
linkcheck_anchors = False


def setup(app: Sphinx) -> None:
    reference_pages.write(HERE / "reference" / "api")
    notebook_cache.prepare(Path(nb_execution_cache_path))
    app.connect("env-before-read-docs", page_order.spread_notebooks)
    app.connect("doctree-read", notebook_cache.report_stderr)
    app.connect("build-finished", notebook_cache.report_failures)
    app.connect("build-finished", local_traces.report)
