"""Run estimators on the draws of a model and turn each `Estimate` into an `Evidence`."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any
from zlib import crc32

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import EvidenceWarning, ModelError, warn
from ..facts import sentences
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..progress import row_progress
from ..pymc_model.density import ModelDensity
from ..pymc_model.inspection import exactness
from ..pymc_model.other_filter import model_of_draws
from ..pymc_model.posterior_draws import are_populations, noise_was_moved, posterior_group
from ..pymc_model.prior import Support
from .agreement import chosen_estimator
from .checks import check_convergence, check_steps
from .estimators.importance import Importance
from .estimators.largest_likelihood import N_EVALUATIONS, max_log_likelihood
from .estimators.protocol import Estimate, Estimator
from .evidence import Evidence, store_evidence
from .evidence_facts import CorrectingFilter, FiltersOfDraws, PartsOfPosterior
from .exact_density import ExactDensity
from .exchangeable_labels import OneOrder, undeclared_labels
from .observed_data import facts_of, observed_in
from .posterior import Posterior
from .posterior_of_draws import build_posterior
from .reweighting.correction import exact_posterior
from .unreached import check_reached

MAXIMUM = "maximum likelihood"
CORRECTION = "correction of the draws"
SHARED = "shared proposals"
UNVISITED = "unvisited tails"
LABELS = "exchangeable labels"
FILTER = "check of the filter"
LESS_CERTAIN = "{} is less certain than its standard error suggests"


def run_estimators(
    idata: xr.DataTree,
    model: pm.Model | None,
    estimators: Sequence[Estimator],
    *,
    filter: Filter | None = None,
    exchangeable: Any = None,
    random_seed: int | np.random.Generator | None,
    extend_inferencedata: bool,
    progressbar: bool,
) -> dict[str, Evidence]:
    """Run estimators with different names on the same draws, and report an `Evidence` for each.

    With another ``filter`` the evidence is that of the model with it. The other arguments are those
    of `chib_jeliazkov`. Raises `ModelError` if estimators average the draws where these may only
    say where the posterior lies. Warns once for all problems that do not depend on the estimator,
    and once if the error of the estimate that is taken is doubtful or too large.
    """
    _check_guided(estimators, idata, filter)
    model = model_of_draws(model, idata)
    began = time.process_time()
    posterior_group(idata)  # fails early, before anything is compiled
    exact = None if filter is None else ExactDensity(model, filter)
    density = ModelDensity(model, moved=noise_was_moved(idata))
    posterior, noise = build_posterior(idata, density)
    entropy = np.random.default_rng(random_seed).integers(2**63, size=2).tolist()

    def stream(name: str) -> np.random.Generator:
        """Random numbers of a purpose, independent of which others run."""
        return np.random.default_rng([*entropy, crc32(name.encode())])

    one_order = OneOrder(exchangeable, density, idata, stream(LABELS)) if exchangeable else None
    undeclared: list[str] = []
    if one_order is not None:
        posterior = one_order.restricted(one_order.sorted_draws(posterior))
    elif exchangeable is None:
        undeclared = list(undeclared_labels(density, idata, stream(LABELS)))
    support = Support.of(model, [] if one_order is None else one_order.ordered)
    is_sorted = one_order is not None and not one_order.ordered
    parts = PartsOfPosterior(idata, model, posterior, stream(UNVISITED), is_sorted)
    common = (
        *support.check(),
        *check_steps(model, idata, posterior.draws),
        *(sentences(FiltersOfDraws(idata, model)) if exact is None else ()),
        *check_convergence(posterior, idata),
        # Draws that miss orders of labels miss modes as well, which is said once.
        *(undeclared or sentences(parts)),
    )
    posterior = replace(posterior, shared_seed=(*entropy, crc32(SHARED.encode())))
    if posterior.population is not None:
        posterior = replace(posterior, remedy="take the evidence that sample_smc has stored")
    with row_progress(exact or density.calls, enabled=progressbar) as announce:
        if exact is not None:
            noise = "refreshed" if exact.n_noisy else "none"
            posterior = exact_posterior(posterior, exact, stream(CORRECTION), announce)
            if one_order is not None:
                posterior = one_order.restricted(posterior)
            seconds = time.process_time() - began
            draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
            given = draws, model, exact.filter, seconds, stream(FILTER)
            off = sentences(CorrectingFilter(*given))
            common, remedy = (*common, *off), _remedy(exact.filter, is_off=bool(off))
            posterior = replace(posterior, remedy=remedy)
        estimates = _estimates(estimators, posterior, stream, announce)
        announce(MAXIMUM, N_EVALUATIONS)
        rng = stream(MAXIMUM)
        largest = max_log_likelihood(posterior, rng)
        if exact is None:
            estimates = _where_reached(estimates, posterior, largest.point, rng)
        if one_order is not None:
            more = one_order.labels.log_orders
            estimates = {
                name: replace(one, log_evidence=one.log_evidence + more)
                for name, one in estimates.items()
            }

    of_model = facts_of(observed_in(model), support) | {
        "n_parameters": posterior.draws.shape[-1],
        "max_log_likelihood": largest.log_likelihood,
        "noise": noise,
        "approximate": not (exactness(model) if exact is None else exact.is_exact),
    }
    found = {}
    for name, estimate in estimates.items():
        doubts = (*common, *estimate.doubts)
        numbers = estimate.log_evidence, estimate.se
        found[name] = Evidence(*numbers, name, doubts="; ".join(doubts), **of_model)
        if extend_inferencedata:
            store_evidence(idata, found[name], dict(estimate.settings))
    # The others check the one that is taken: what is doubtful about them is in the result alone.
    taken = chosen_estimator(found)
    _warn(LESS_CERTAIN.format("the log-evidence"), common)
    by_name = {one.name: one for one in estimators}
    _warn(*_problem(by_name[taken], estimates[taken]))
    return found


def _remedy(filter: Filter, *, is_off: bool) -> str:
    """What helps where proposals are poor for the estimates by another filter."""
    if is_off:
        return f"use another filter than {short_form(filter)}"
    if filter.noisy:
        return f"give {short_form(filter)} more particles"
    return f"draw from the model with {short_form(filter)}"


def _where_reached(
    estimates: dict[str, Estimate],
    posterior: Posterior,
    peak: NDArray[np.float64],
    rng: np.random.Generator,
) -> dict[str, Estimate]:
    """Estimates without an error, and with a doubt, if their draws never reached the posterior."""
    largest = max(one.log_evidence for one in estimates.values())
    reason = check_reached(posterior, peak, largest, rng)
    if not reason:
        return estimates
    return {
        name: replace(one, se=math.nan, doubts=(reason, *one.doubts), shortfall="")
        for name, one in estimates.items()
    }


def _problem(estimator: Estimator, estimate: Estimate) -> tuple[str, Sequence[str]]:
    """The warning about one estimate: a message and its reasons, which may be none."""
    number = f"log-evidence {estimate.log_evidence:.2f} ({estimator.name})"
    message = LESS_CERTAIN.format(number) if estimate.doubts else number
    if not estimate.shortfall:
        return message, estimate.doubts
    target = getattr(estimator, "target_se", None)
    above = "target_se" if target is None else f"target_se={target:g}"
    error = f"its standard error of {estimate.se:.2g} is above {above} ({estimate.shortfall})"
    return message, [*estimate.doubts, error]


def _check_guided(
    estimators: Sequence[Estimator], idata: xr.DataTree, filter: Filter | None
) -> None:
    """Raise if draws that only say where the posterior lies would be averaged.

    Those of chains at another filter are of another posterior, and the populations of `sample_smc`
    are few independent draws.
    """
    if filter is None and not are_populations(idata):
        return
    if refused := [one.name for one in estimators if not isinstance(one, Importance)]:
        raise ModelError(
            "with filter=, and of sample_smc, the draws say where the posterior lies and are not "
            f"averaged: use estimate_evidence with estimators='importance', got {refused}"
        )


def _estimates(
    estimators: Sequence[Estimator],
    posterior: Posterior,
    stream: Callable[[str], np.random.Generator],
    announce: Callable[[str, int], None],
) -> dict[str, Estimate]:
    """Run the estimators in turn."""
    estimates = {}
    for estimator in estimators:
        name = estimator.name
        announce(name, estimator.n_evaluations(posterior))
        try:
            estimates[name] = estimator.estimate(posterior, rng=stream(name))
        except ModelError as error:
            error.add_note(f"raised by the estimator {name!r}")
            raise
    return estimates


def _warn(message: str, reasons: Sequence[str]) -> None:
    if reasons:
        warn(f"{message}: {'; '.join(reasons)}", EvidenceWarning)
