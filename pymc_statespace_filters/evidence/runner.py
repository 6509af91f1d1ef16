"""From draws and a model to `Evidence`: what every estimator has in common."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from zlib import crc32

import numpy as np
import pymc as pm
import xarray as xr

from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence.checks import doubts_of_draws, doubts_of_steps
from pymc_statespace_filters.evidence.estimators.maximum_likelihood import (
    N_EVALUATIONS,
    max_log_likelihood,
)
from pymc_statespace_filters.evidence.estimators.protocol import Estimate, Estimator
from pymc_statespace_filters.evidence.evidence import Evidence, store_evidence
from pymc_statespace_filters.evidence.posterior import (
    ModelDensity,
    Posterior,
    posterior_of,
)
from pymc_statespace_filters.evidence.posterior.observed_data import (
    data_fingerprint,
    observation_count,
)
from pymc_statespace_filters.evidence.posterior.support import Support
from pymc_statespace_filters.progress import row_progress
from pymc_statespace_filters.pymc_model.posterior_draws import noise_was_moved, posterior_group

MAXIMUM = "maximum likelihood"


def evidences_of(
    idata: xr.DataTree,
    model: pm.Model | None,
    estimators: Mapping[str, Estimator],
    *,
    random_seed: int | np.random.Generator | None,
    extend_inferencedata: bool,
    progressbar: bool,
) -> dict[str, Evidence]:
    """Run estimators on the same draws and report each as an `Evidence`.

    Parameters
    ----------
    idata, model, random_seed, extend_inferencedata, progressbar
        As in `chib_jeliazkov`.
    estimators : mapping of str to Estimator
        By the name that the result will carry.

    Returns
    -------
    dict of str to Evidence

    Warns
    -----
    EvidenceWarning
        Once for what is doubtful whatever the estimator, once for each estimate that is, and once
        for each estimator that cannot treat the model while another can.
    """
    if not isinstance(model, pm.Model | None):
        raise ModelError(f"model must be a pymc.Model, got {type(model).__name__}")
    posterior_group(idata)  # raises what is wrong with it, before anything is compiled
    density = ModelDensity(pm.modelcontext(model), moved=noise_was_moved(idata))
    posterior, noise = posterior_of(idata, density)
    support = Support.of(density.model)
    common = (
        *support.doubts(),
        *doubts_of_draws(posterior),
        *doubts_of_steps(density.model, idata, posterior.draws),
    )
    entropy = np.random.default_rng(random_seed).integers(2**63, size=2)

    def stream(name: str) -> np.random.Generator:
        """The same for an estimator whatever the others are."""
        return np.random.default_rng([*entropy, crc32(name.encode())])

    with row_progress(density, enabled=progressbar) as announce:
        estimates, refusals = _estimates(estimators, posterior, stream, announce)
        announce(MAXIMUM, N_EVALUATIONS)
        largest = max_log_likelihood(posterior, stream(MAXIMUM)).log_likelihood

    _warn("the log-evidence is less certain than its error says", common)
    for name, refusal in refusals.items():
        _warn(f"no estimate by {name}", [str(refusal)])
    of_model = {
        "n_parameters": posterior.draws.shape[-1],
        "n_observations": observation_count(density.model),
        "max_log_likelihood": largest,
        "data_fingerprint": data_fingerprint(density.model),
        "noise": noise,
        "log_volume": support.log_volume,
        "uniform": support.uniform,
        "improper": support.improper,
    }
    found = {}
    for name, estimate in estimates.items():
        number = f"{estimate.log_evidence:.2f} ({name})"
        _warn(f"log-evidence {number} is less certain than its error says", estimate.doubts)
        doubts = "; ".join((*common, *estimate.doubts))
        found[name] = Evidence(estimate.log_evidence, estimate.se, name, doubts=doubts, **of_model)
        if extend_inferencedata:
            store_evidence(idata, found[name], dict(estimate.settings))
    return found


def _estimates(
    estimators: Mapping[str, Estimator],
    posterior: Posterior,
    stream: Callable[[str], np.random.Generator],
    announce: Callable[[str, int], None],
) -> tuple[dict[str, Estimate], dict[str, ModelError]]:
    """Run one after the other; one that cannot treat the model does not cost the others' work."""
    estimates: dict[str, Estimate] = {}
    refusals: dict[str, ModelError] = {}
    for name, estimator in estimators.items():
        announce(name, estimator.n_evaluations(posterior))
        try:
            estimates[name] = estimator.estimate(posterior, rng=stream(name))
        except ModelError as error:
            error.add_note(f"raised by the estimator {name!r}")
            refusals[name] = error
    if not estimates:
        raise next(iter(refusals.values()))
    return estimates, refusals


def _warn(message: str, doubts: Sequence[str]) -> None:
    if doubts:
        warnings.warn(f"{message}: {'; '.join(doubts)}", EvidenceWarning, stacklevel=4)
