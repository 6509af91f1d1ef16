"""The checks of all StateSpace variables of a model at draws of its posterior."""

import json
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import NDArray

from ...compiler.lowering.compiled_system import compile_system
from ...errors import ModelError
from ...filters.bootstrap import BootstrapPF
from ...filters.checks import check_system_and_filter
from ...filters.protocol import Filter
from ...filters.rbpf import RBPF
from ...filters.written import short_form
from ...progress import row_progress
from ...pymc_model.at_points import GraphsAtPoints
from ...pymc_model.elements import element_names
from ...pymc_model.filter_estimates import VariableAtPoints
from ...pymc_model.inspection import log_density_terms, state_space_nodes
from ...pymc_model.posterior_draws import posterior_group, unconstrained_draws
from .bias import bias_at_draws, bias_elsewhere, is_settled, not_compared
from .budget import Budget
from .estimates import Comparison, compare, is_unbiased, witnesses
from .finding import EXACT, FINE, OFF, UNDECIDED, Finding
from .low import low_at
from .points import SPREADS, points_elsewhere

Array = NDArray[np.float64]

# The attribute of results that holds the outcome for each variable.
ATTRIBUTE = "filter_check"
# Worst first.
_ORDER = (OFF, UNDECIDED, FINE, EXACT)
# Nats by which a point may be less likely than the draws, beside the volume where it lies.
_SLACK = 3.0
_MOST_DRAWS = 500  # of each chain, from which mean and spread are taken
_GROWTH, _MOST_COMPARED = 4, 160  # draws, times as many until they are enough, and at most
# Of the check at the end of a calculation: points, and CPU seconds with the compilation of a
# witness, or the share of those of the calculation if that is more.
N_POINTS, LEAST_SECONDS, _SHARE = 20, 1.0, 0.1
# Points for a filter that corrects draws: it may be too low at few of them.
MORE_POINTS = 40


def _needs_check(system: Any, filter: Filter) -> bool:
    """Whether the likelihood of a filter may be off for reasons that its noise does not show."""
    compiled = compile_system(system)
    if (isinstance(filter, BootstrapPF) and filter.unbiased) or (
        isinstance(filter, RBPF) and filter.is_exact_for(compiled)
    ):
        return False
    return not filter.is_exact_for(compiled) or (filter.noisy and not compiled.is_linear)


def _draws_of(draws: xr.DataTree | Array, model: pm.Model) -> Array:
    """Draws (n, k) on the unconstrained space, of a result all or some hundred of each chain."""
    if isinstance(draws, np.ndarray):
        return draws
    posterior = posterior_group(draws)
    every = max(1, posterior.sizes["draw"] // _MOST_DRAWS)
    thinned = xr.DataTree.from_dict({"posterior": posterior.isel(draw=slice(None, None, every))})
    found = unconstrained_draws(thinned, model)
    return found.reshape(-1, found.shape[-1])


def check_model(
    draws: xr.DataTree | Array,
    model: pm.Model,
    *,
    filter: Filter | None,
    n_points: int,
    budget: Budget,
    rng: np.random.Generator,
    progressbar: bool = False,
) -> pd.DataFrame:
    """Check the filters of all observed StateSpace variables, at draws of the posterior.

    They are those of a result, or draws (n, k) of the unconstrained space. ``filter`` is checked in
    their place; None: their own. All variables have an equal part of the ``budget``.
    """
    nodes = state_space_nodes(model)
    chosen = {
        name: filter or node.op.filter
        for name, node in nodes.items()
        if node.outputs[1] in model.observed_RVs
    }
    if not chosen:
        raise ModelError("model must have an observed StateSpace variable, got none")
    for name, one in chosen.items():
        check_system_and_filter(nodes[name].op.system, one)
    checked = {n for n, one in chosen.items() if _needs_check(nodes[n].op.system, one)}
    x = _draws_of(draws, model) if checked else np.empty((0, 0))
    rows = []
    for name, one in chosen.items():
        if name in checked:
            part = budget.part(len(checked))
            with row_progress(part, enabled=progressbar) as begin, np.errstate(invalid="ignore"):
                begin(f"check of {short_form(one)} of {name}", n_points)
                # Invalid is minus infinity minus itself: failures.
                findings = _check_variable(model, name, one, x, n_points, part, rng)
        else:
            findings = [_plain_row(one)]
        rows += [{"variable": name, "filter": short_form(one)} | f._asdict() for f in findings]
    return pd.DataFrame(rows)


def check_at_end(
    draws: xr.DataTree | Array,
    model: pm.Model,
    filter: Filter | None,
    seconds: float,
    rng: np.random.Generator,
    n_points: int = N_POINTS,
) -> dict[str, dict[str, str]]:
    """The outcomes for all variables, at the end of a calculation that took so many CPU seconds."""
    seconds = max(LEAST_SECONDS * n_points / N_POINTS, _SHARE * seconds)
    budget = Budget(seconds, counts_compilation=True)
    found = check_model(draws, model, filter=filter, n_points=n_points, budget=budget, rng=rng)
    return outcomes_of(found)


def _plain_row(filter: Filter) -> Finding:
    name = short_form(filter)
    if filter.noisy:
        verdict = f"{name} is unbiased; suggest_particles measures how much its estimates scatter"
    else:
        verdict = f"{name} is exact for this system"
    return Finding("exact", 0.0, 0.0, np.nan, 0.0, EXACT, verdict)


def _check_variable(
    model: pm.Model,
    name: str,
    filter: Filter,
    draws: Array,
    n_points: int,
    budget: Budget,
    rng: np.random.Generator,
) -> list[Finding]:
    n_elsewhere = n_points // 2
    x = draws[rng.permutation(len(draws))[:_MOST_COMPARED]]
    n_draws = min(n_points - n_elsewhere, len(x))
    variable = VariableAtPoints(model, name, x[:n_draws])
    scored, names = not is_unbiased(filter), element_names(model)
    evaluate = partial(compare, budget=budget, rng=rng, scored=scored)

    def judged(found: Comparison) -> list[Finding]:
        if not scored:
            return [low_at(found, "at draws")]
        n, sd = len(found.checked.logs), draws.std(axis=0)
        return bias_at_draws(found, x[:n] / np.where(sd > 0.0, sd, 1.0), names)

    found: Comparison | None = None
    reason = "not compiled yet" if budget.counts_compilation else "not known for this system"
    findings = [not_compared(filter, f"a filter to compare it with is {reason}")]
    for witness in witnesses(variable, filter, budget):
        if found is None:
            found = evaluate(variable, [filter, witness])
        else:
            found = found.with_witness(evaluate(variable, [witness]).checked)
        findings = judged(found)
        if findings[0].outcome != UNDECIDED or budget.is_spent:
            break
    if found is None:
        return findings
    filters = [filter, *(one.filter for one in found.witnesses)]
    is_low: list[Finding] = []
    if not budget.is_spent:
        points, factors = points_elsewhere(model, draws, n_elsewhere, rng)
        others = evaluate(variable.moved_to(points), filters)
        others = others.at(_is_relevant(model, name, draws, (x, found), (points, others), factors))
        if len(others.checked.logs):
            is_low = bias_elsewhere(others, found) if scored else [low_at(others, "elsewhere")]
    while n_draws < len(x) and not (is_settled(findings) or budget.is_spent):
        more = x[n_draws : _GROWTH * n_draws]
        found = found.joined(evaluate(variable.moved_to(more), filters))
        findings, n_draws = judged(found), n_draws + len(more)
    return [*findings, *is_low]


def _is_relevant(
    model: pm.Model,
    name: str,
    draws: Array,
    at_draws: tuple[Array, Comparison],
    others: tuple[Array, Comparison],
    factors: Array,
) -> NDArray[np.bool_]:
    """Which other points the posterior would hold, by the highest of all estimates there.

    By the weight of each in importance sampling: moved away, from the posterior that is as many
    times wider; of the prior, by its likelihood over the evidence, too. Of points that were
    compared, the first: the others have no estimates.
    """
    free = {rv.name for rv in model.free_RVs}
    terms = log_density_terms(model)
    prior = pt.sum([term.sum() for variable, term in terms if variable in free])
    data = [term.sum() for variable, term in terms if variable not in {name, *free}]
    highest = [found.highest for _, found in (at_draws, others)]
    n, m = map(len, highest)
    x = np.concatenate([at_draws[0][:n], others[0][:m]])
    log_prior, *of_data = GraphsAtPoints(model, [prior, *data])(x)
    likelihood = np.concatenate(highest) + np.sum(of_data, axis=0)
    density = likelihood + log_prior
    known = density[:n][np.isfinite(density[:n])]
    times_wider = x.shape[1] * np.log(np.minimum(factors[:m], max(SPREADS)))
    weight = density[n:] - known.min(initial=np.inf) + times_wider
    of_prior = np.isinf(factors[:m])
    if known.size and of_prior.any():
        log_evidence = known.mean() + _normal_entropy(draws)
        weight[of_prior] = np.minimum(weight, likelihood[n:] - log_evidence)[of_prior]
    return weight >= -_SLACK


def _normal_entropy(draws: Array) -> float:
    """The entropy of a normal distribution with the covariance of draws (n, k); -inf without one.

    A posterior has at most as much, so that the evidence is not larger than with it.
    """
    _, log_det = np.linalg.slogdet(np.atleast_2d(np.cov(draws, rowvar=False)))
    return float(0.5 * (draws.shape[1] * np.log(2 * np.pi * np.e) + log_det))


def outcomes_of(table: pd.DataFrame) -> dict[str, dict[str, str]]:
    """The worst finding of every variable: filter, outcome and verdict."""
    worst = {}
    for name, rows in table.groupby("variable", sort=False):
        row = min(rows.to_dict("records"), key=lambda one: _ORDER.index(one["outcome"]))
        worst[str(name)] = {key: row[key] for key in ("filter", "outcome", "verdict")}
    return worst


def store(idata: xr.DataTree, outcomes: Mapping[str, Mapping[str, str]]) -> None:
    """Keep the outcomes with the draws, which are not exact if a filter is off."""
    idata.attrs[ATTRIBUTE] = json.dumps(outcomes)  # files of netCDF and Zarr store no mappings
    if doubts(outcomes):
        idata.attrs["exact"] = 0


def doubts(outcomes: Mapping[str, Mapping[str, str]]) -> list[str]:
    """What is wrong with the filters that are off, each with the name of its variable."""
    return [f"{name}: {o['verdict']}" for name, o in outcomes.items() if o["outcome"] == OFF]


def kept(former: xr.DataTree, filter: Filter) -> dict[str, dict[str, str]]:
    """The outcomes of a result that hold for further rows, which went through this filter.

    That it is off, and that there is nothing to compare; no sign in some rows says nothing of more.
    """
    found = {}
    for name, one in json.loads(former.attrs.get(ATTRIBUTE, "{}")).items():
        if one["outcome"] == EXACT:  # for any number of members
            verdict = _plain_row(filter).verdict
            found[name] = {"filter": short_form(filter), "outcome": EXACT, "verdict": verdict}
        elif one["outcome"] == OFF and one["filter"] == short_form(filter):
            found[name] = one
    return found


def stored(idata: xr.DataTree, model: pm.Model, outcome: str) -> list[str]:
    """The verdicts, stored with the draws, on filters that the model has and have this outcome."""
    found = json.loads(idata.attrs.get(ATTRIBUTE, "{}"))
    nodes = state_space_nodes(model)
    return [
        one["verdict"]
        for name, one in found.items()
        if one["outcome"] == outcome
        and name in nodes
        and one["filter"] == short_form(nodes[name].op.filter)
    ]
