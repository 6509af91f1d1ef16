"""Scripts that use the checkpoint alone."""

WITHOUT_PYMC = """
import sys, types
from importlib.util import find_spec
from pathlib import Path

sources = Path(find_spec("pymc_statespace_filters").origin).parents[1]
for name in (
    "pymc_statespace_filters",
    "pymc_statespace_filters.sampling",
    "pymc_statespace_filters.sampling.checkpoint",
):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [str(sources / name.replace(".", "/"))]
"""
"""To begin a script with: PyMC, which takes seconds to import and to fork, is not imported."""
