"""Likelihoods, sampling and model choice for nonlinear state-space models in PyMC."""

import importlib
import sys
from typing import Any

import lazy_loader

from .former_names import NAMES, PLACES

__version__ = "0.1.0"

# Names are imported when they are first used; `__init__.pyi` lists them.
_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in PLACES:
        return importlib.import_module(f".{name}", __name__)
    if name not in NAMES:
        return _import_name(name)
    text = f"{__name__}.{name} {NAMES[name]}."
    # `from ... import` replaces an AttributeError by a text of its own.
    if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
        raise ImportError(text, name=__name__)
    raise AttributeError(text, name=name)
