"""Likelihoods, sampling and model choice for nonlinear state-space models in PyMC."""

import sys
from typing import Any

import lazy_loader

__version__ = "0.1.0"

# Names are imported when they are first used; `__init__.pyi` lists them.
_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Names that were once here.
_MOVED = {
    "compartments": ("euler_multinomial", "gamma_white_noise"),
    "errors": (
        "CheckpointError",
        "CheckpointWarning",
        "DataMismatchError",
        "EvidenceWarning",
        "FilterWarning",
        "GradientUnavailableError",
        "LoweringError",
        "ModelError",
        "ParallelError",
        "ParallelWarning",
        "StateSpaceFiltersError",
    ),
    "evidence": ("Evidence",),
    "mechanics": (
        "cubic",
        "freeplay",
        "hysteresis",
        "hysteresis_branch",
        "second_order",
    ),
    "point_estimation": ("MaximumLikelihoodEstimate",),
}
_INSTEAD = {
    name: f"has moved to {__name__}.{module}.{name}"
    for module, names in _MOVED.items()
    for name in names
} | {
    "linear_modes": "has gone: the how-to on validation has it in ten lines",
    "DimensionCorrection": "has gone: give compare_evidence a model_prior",
    "marginal_modes": "has gone: use arviz.mode",
    "plot_phase": "has gone: plot a state of idata['smoothed_states'] against another",
    "relevance": "has gone: use select_terms",
}


def __getattr__(name: str) -> Any:
    if name not in _INSTEAD:
        return _import_name(name)
    text = f"{__name__}.{name} {_INSTEAD[name]}."
    # `from ... import` replaces an AttributeError by a text of its own.
    if sys._getframe(1).f_globals.get("__name__") == "importlib._bootstrap":
        raise ImportError(text, name=__name__)
    raise AttributeError(text, name=name)
