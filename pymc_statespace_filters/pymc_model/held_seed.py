"""The warning that a sampler of PyMC evaluates an estimated likelihood with one seed throughout.

The draws are then those of the posterior under that seed. PyMC does not tell a log-density who asks
for it, so the call stack is read: the first function outside PyMC's own graphs asks. `DRAM` and
`sample_dram` ask from this package, and so do functions that evaluate or predict.
"""

import sys
from pathlib import Path
from types import FrameType

import pymc
import pytensor

from ..errors import FilterWarning, warn
from ..filters.protocol import Filter
from ..filters.written import short_form

_SAMPLERS = ("pymc.step_methods.", "pymc.smc.")
# Those with gradients, of which there are none: an error says so.
WITH_GRADIENT = ("pymc.step_methods.hmc.", "pymc.step_methods.arraystep.")
_GRAPHS = ("pymc.logprob.", "pymc.model.", "pytensor.", "functools", f"{__package__}.")
# Files between the package and the line of the user.
BETWEEN = tuple(str(Path(module.__file__).parent) for module in (pymc, pytensor))


def warn_of_held_seed(filter: Filter) -> None:
    """Warn if a sampler of PyMC asks for the log-density of a filter with noise."""
    who = asks_from() if filter.noisy else ""
    if who.startswith(_SAMPLERS) and not who.startswith(WITH_GRADIENT):
        warn(
            f"{short_form(filter)}: this sampler evaluates the estimated likelihood with one noise "
            "seed throughout. If it moves parameters of the likelihood, its draws are those of the "
            "posterior under that seed, with the error of the estimate. Use psf.sample_dram() or "
            "pm.sample(step=psf.DRAM()), which draw new noise for each proposal.",
            FilterWarning,
            *BETWEEN,
        )


def asks_from() -> str:
    """The name of the module that asks for the log-density, with a dot behind it."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        module = f"{frame.f_globals.get('__name__', '')}."
        if not module.startswith(_GRAPHS):
            return module
        frame = frame.f_back
    return ""
