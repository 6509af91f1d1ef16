"""Sphinx settings."""

from importlib.metadata import version as installed_version
from inspect import signature

from pymc_statespace_filters import DRAM

project = "pymc-statespace-filters"
author = "The pymc-statespace-filters developers"
release = version = installed_version(project)

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc"]
myst_enable_extensions = ["dollarmath"]
exclude_patterns = ["_build"]

# The reference is the list of public names in __init__.py, in its order.
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and types are told in the docstrings
numpydoc_show_class_members = False
# Sphinx would show that of __new__, by which PyMC makes every step method: (*args, **kwargs).
DRAM.__signature__ = signature(DRAM)

html_theme = "pydata_sphinx_theme"
html_title = "pymc-statespace-filters"
html_theme_options = {"show_prev_next": False}
html_sidebars = {"**": []}
