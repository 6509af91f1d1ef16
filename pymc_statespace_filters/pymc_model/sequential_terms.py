"""The warning that the terms of an observation are conditional on the earlier ones.

ArviZ takes stored terms for those of leave-one-out cross-validation, and cannot know better.
"""

from ..errors import EvidenceWarning, warn
from .held_seed import BETWEEN, asks_from

_STORES_TERMS = "pymc.stats.log_density."  # pm.compute_log_likelihood, also within pm.sample


def warn_of_sequence(whose: str, instead: str = "") -> None:
    """Warn that terms are sequential; ``instead`` is what else to do."""
    warn(
        f"the terms of {whose} are conditional on the earlier observations: az.loo and az.compare "
        "of them are no leave-one-out cross-validation. Compare scores "
        "psf.leave_future_out(idata, model, min_observations=..., refit=lambda model: "
        f"psf.sample_dram(model=model)){instead}",
        EvidenceWarning,
        *BETWEEN,
    )


def warn_of_stored_terms(*, is_panel: bool) -> None:
    """Warn if PyMC asks for the terms of a variable to store them."""
    if asks_from().startswith(_STORES_TERMS):
        of_records = ", or psf.compute_log_likelihood, which sums them by record"
        warn_of_sequence("a StateSpace variable", of_records if is_panel else "")
