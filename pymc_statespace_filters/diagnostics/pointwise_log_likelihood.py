"""Sequential log-likelihood terms at every draw, each with the noise of its own estimate."""

from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError
from ..filters.protocol import properties
from ..pymc_model.checked_model import checked_model
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.sequential_terms import warn_of_sequence
from ..pymc_model.state_space_variable import StateSpaceVariable, terms_of
from ..states.draws import PosteriorDraws, select_draws
from ..states.groups import add_group, results_by_row, times_of
from ..states.record import Array, RecordAtDraws
from ..states.variable import VariableAtDraws, select_variables

SEQUENTIAL = (
    "log p(d_j | d_1 .. d_{j-1}, theta): each term is conditional on all earlier observations. "
    "Leave-one-out cross-validation (az.loo) is invalid with such terms, because later terms "
    "depend on the observation left out; use leave_future_out."
)

OF_RECORDS = (
    "log p(record | theta): the sum of the terms of each record of the panel. Leave-one-out "
    "cross-validation (az.loo) leaves out whole records."
)


@shared_by_ranks
def compute_log_likelihood(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    new_data: bool = False,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    comm: Any = None,
) -> xr.DataTree:
    r"""Evaluate the log-likelihood terms at every draw, with the draw's own noise.

    The terms :math:`\log p(d_j \mid d_1 \dots d_{j-1}, \theta)` are **sequential**: each is
    conditional on all earlier observations. `leave_future_out` uses them. ``az.loo``, and with it
    ``az.compare`` of DataTrees, is invalid with them, because the terms of later observations
    depend on the observation that is left out. ArviZ does not warn; this function and
    ``pm.compute_log_likelihood`` do, and ``elpd_i`` of a pointwise result has the attribute
    ``terms``, which says so.

    The terms of a **panel** are summed by record. With these sums ``az.loo`` leaves out whole
    records, and is valid: records are independent given the parameters. Records with parameters of
    their own often determine them alone; then the weights are unreliable, and Pareto k says so.

    The likelihood by a particle or ensemble filter is an estimate that depends on a noise seed.
    `sample_dram` stores the seed of each draw, and with it the terms add up to the estimate by
    which the draw was accepted. (``pm.compute_log_likelihood`` uses the seed held by the model for
    all draws, and so gives other estimates.) A `GuidedPF` places its particles for the whole
    record. Its terms are differences of the log-likelihoods of records that end with each row,
    which takes half as many times longer as there are rows.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws. If ``sample_stats`` holds no seeds, the seed of the model is used.
    model, var_name, new_data, progressbar, comm
        As in `filtered_states`.
    extend_inferencedata : bool
        Whether to add the terms to the group of `idata`, beside those of other variables; otherwise
        the group is returned in a new DataTree.

    Returns
    -------
    xarray.DataTree
        With the group ``log_likelihood``: for a variable "d" its terms ``d`` (chain, draw, d_time),
        0 for an observation that is entirely missing or before ``score_from``, -inf from a failure
        of the filter on. The attribute ``terms`` says that they are sequential. For a panel, the
        log-likelihood of every record, ``d`` (chain, draw, d_record).

    Raises
    ------
    ModelError
        If draws and model are inconsistent, or the chain moved its noise (``correlation``), so that
        no seed reproduces the estimates.
    DataMismatchError
        If the draws are those of another model or, unless ``new_data``, of other data.

    Warns
    -----
    EvidenceWarning
        That the terms of a variable without a panel are not those that ``az.loo`` needs.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Normal("a", 0, 0.5)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), panel=["A", "A", "B"], steps=[0, 1, 2],
    ...         observed=[0.3, 1.2, 0.4],
    ...     )
    ...     idata = psf.sample_dram(100, tune=100, chains=2, random_seed=1, progressbar=False)
    ...     terms = psf.compute_log_likelihood(idata)["log_likelihood"]["d"]
    >>> dict(terms.sizes)
    {'chain': 2, 'draw': 100, 'd_record': 2}
    """
    model = checked_model(model, idata, new_data=new_data)
    draws, variables = select_draws(idata, None), select_variables(model, var_name)
    if names := [repr(one.name) for one in variables if not one.is_panel]:
        warn_of_sequence(", ".join(names))
    found = xr.merge(
        [
            (_terms_of_records if variable.is_panel else sequential_terms)(
                model, variable, draws, progressbar=progressbar
            ).to_dataset()
            for variable in variables
        ]
    )
    if extend_inferencedata and "log_likelihood" in idata.children:
        present = idata["log_likelihood"].to_dataset()
        found = found.merge(present[[name for name in present.data_vars if name not in found]])
    return add_group(idata, "log_likelihood", found, {}, extend_inferencedata)


def sequential_terms(
    model: pm.Model,
    variable: StateSpaceVariable,
    draws: PosteriorDraws,
    *,
    progressbar: bool = False,
) -> xr.DataArray:
    """The terms (chain, draw, time) of one variable without a panel, with the noise of each draw.

    They are evaluated at the stored, constrained values, so that the estimates of the chain are
    reproduced to the last digit.
    """
    at_draws = VariableAtDraws(model, variable, draws)
    name, (record,) = variable.name, at_draws.records
    times = times_of(at_draws, [record.steps])
    found = results_by_row(at_draws, times, {name: ("", _terms(at_draws, progressbar))})[name]
    return found.assign_attrs(terms=SEQUENTIAL)


def _terms_of_records(
    model: pm.Model, variable: StateSpaceVariable, draws: PosteriorDraws, *, progressbar: bool
) -> xr.DataArray:
    """The log-likelihood (chain, draw, record) of every record of a panel."""
    at_draws = VariableAtDraws(model, variable, draws)
    name, dim = variable.name, f"{variable.name}_record"
    sums = np.stack([terms.sum(axis=1) for terms in _terms(at_draws, progressbar)], axis=1)
    labels = [record.label for record in at_draws.records]
    found = draws.dataset({name: ((dim,), sums)}, {dim: labels})[name]
    return found.assign_attrs(terms=OF_RECORDS)


def _terms(at_draws: VariableAtDraws, progressbar: bool) -> list[Array]:
    """The terms (draws, J) of every record; 0 where they are not scored."""
    variable = at_draws.variable
    if variable.filter.noisy and at_draws.draws.noise_moved:
        raise ModelError(
            f"the noise of {variable.name!r} was moved along the chain (correlation), so that no "
            "seed reproduces the estimates of these draws: sample without correlation"
        )
    seeds = at_draws.stored_seeds
    if seeds is None:  # use the model's seed; a deterministic filter ignores it
        held = variable.seed.eval(mode="FAST_COMPILE")
        seeds = np.full(at_draws.n_draws, held, dtype=np.int64)
    found = []
    with at_draws.progress(f"terms of {variable.name}", enabled=progressbar):
        for record in at_draws.records:
            noise = record.noise_of(seeds)
            looks_ahead = properties(variable.filter).needs_record_ahead
            apart = looks_ahead and not variable.is_panel
            terms = _increments(record, noise) if apart else _terms_at_once(record, noise)
            terms[:, : variable.score_from] = 0.0
            found.append(terms)
    return found


def _terms_at_once(record: RecordAtDraws, noise: NDArray[np.int64]) -> Array:
    (terms,) = record.evaluate(terms_of(record.variable), {"seed": noise})
    return terms


def _increments(record: RecordAtDraws, noise: NDArray[np.int64]) -> Array:
    """By how much each row adds to the log-likelihood of the rows until then.

    The terms of a filter that looks ahead are of particles placed for the whole record.
    """
    totals = np.empty((len(noise), len(record.steps)))
    for j in range(len(record.steps)):
        until = replace(record, steps=record.steps[: j + 1], observed=record.observed[: j + 1])
        totals[:, j] = _terms_at_once(until, noise).sum(axis=1)
    failed = np.logical_or.accumulate(np.isneginf(totals), axis=1)
    with np.errstate(invalid="ignore"):
        return np.where(failed, -np.inf, np.diff(totals, prepend=0.0))
