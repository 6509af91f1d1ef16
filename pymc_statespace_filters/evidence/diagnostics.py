"""When an evidence should not be trusted as it stands."""

import warnings

import arviz as az
import numpy as np

from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence.posterior import Posterior

MIN_EFFECTIVE = 100  # with fewer effective terms the standard error is itself a guess
MAX_RHAT = 1.05
MAX_GAP = 4.0


def warn_if_doubtful(
    posterior: Posterior,
    log_evidence: float,
    *,
    gap: float,
    n_effective_draws: float,
    n_effective_proposals: float,
) -> None:
    """Warn once, with every reason, where the error of an evidence may be larger than it says.

    Parameters
    ----------
    posterior : Posterior
        Its chains are compared by R-hat, parameter by parameter.
    log_evidence : float
        Quoted in the warning.
    gap : float
        Difference between the estimates from the two halves of the draws, in standard errors.
    n_effective_draws, n_effective_proposals : float
        Inverse squared relative errors of the mean over draws and of that over proposals.
    """
    reasons = []
    if n_effective_draws < MIN_EFFECTIVE:
        reasons.append(
            f"the draws near its central point are worth {n_effective_draws:.0f} independent "
            f"ones, fewer than {MIN_EFFECTIVE}: draw more"
        )
    if n_effective_proposals < MIN_EFFECTIVE:
        reasons.append(
            f"the proposals are worth {n_effective_proposals:.0f} independent ones, fewer than "
            f"{MIN_EFFECTIVE}: raise n_proposals, or give the parameters a scale on which their "
            "posterior is nearer to a Gaussian"
        )
    rhat = max(float(az.rhat(values)) for values in np.moveaxis(posterior.draws, -1, 0))
    if rhat > MAX_RHAT:
        reasons.append(f"the chains disagree (R-hat {rhat:.2f}): run them longer")
    if abs(gap) > MAX_GAP:
        reasons.append(f"the halves of the draws differ by {abs(gap):.1f} of their standard errors")
    if reasons:
        message = f"log-evidence {log_evidence:.2f} is less certain than its error says: "
        warnings.warn(message + "; ".join(reasons), EvidenceWarning, stacklevel=3)
