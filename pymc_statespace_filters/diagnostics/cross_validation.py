"""Leave-future-out cross-validation of one-step-ahead predictions."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from arviz_stats import ELPDDataLFO, SamplingWrapper, ess, lfo_cv
from numpy.typing import NDArray
from pymc.model.fgraph import fgraph_from_model, model_from_fgraph
from scipy.special import logsumexp

from ..errors import EvidenceWarning, ModelError, warn
from ..pymc_model.checked_model import checked_model
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.state_space_variable import StateSpaceVariable
from ..states.draws import select_draws
from ..states.variable import select_variables
from ..statistics.importance import largest_good_k, smoothed
from ..system.checks import is_integer
from .pointwise_log_likelihood import SEQUENTIAL, sequential_terms

Refit = Callable[[pm.Model], xr.DataTree]


@shared_by_ranks
def leave_future_out(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    min_observations: int | None = None,
    var_name: str | None = None,
    refit: Refit | None = None,
    progressbar: bool = True,
    comm: Any = None,
) -> ELPDDataLFO:
    r"""Score each observation by its predictive density given the observations before it.

    Leave-future-out cross-validation one step ahead: the sum over :math:`j > L` of
    :math:`\log p(d_j \mid d_1 \dots d_{j-1})
    = \log E[p(d_j \mid d_1 \dots d_{j-1}, \theta)]`, where :math:`\theta` has the posterior given
    :math:`d_1 \dots d_{j-1}` alone. This is the cross-validation to which the sequential terms of a
    state-space model belong; leave-one-out cross-validation (``az.loo``) is invalid with them.

    Without `refit`, the posteriors given fewer observations are obtained from the full posterior by
    Pareto-smoothed weights
    :math:`\exp(-\sum_{i \ge j} \log p(d_i \mid d_1 \dots d_{i-1}, \theta))`. This needs no further
    sampling and is reliable as long as the later data are not too informative; scores with
    unreliable weights are NaN. With `refit` it is ``az.lfo_cv``: a first fit to the first
    `min_observations`, weights that add later observations, and a new fit where the weights become
    unreliable.

    Each draw is used with the noise of its own likelihood estimate. With an unbiased filter
    (`BootstrapPF`) both methods are therefore exact in the limit of many draws, for any number of
    particles: parameters and noise have a joint posterior, whose likelihood terms are the
    estimates.

    The sum over :math:`j > L` is the log-evidence of all observations minus that of the first
    :math:`L`; for :math:`L = 0` it is the log-evidence, which `estimate_evidence` estimates better.
    The terms left out are those that depend most on the width of the priors.

    Parameters
    ----------
    idata : xarray.DataTree
        Draws of the posterior given all observations. The terms in its group ``log_likelihood`` are
        used if `compute_log_likelihood` stored them; otherwise they are computed.
    model : pymc.Model, optional
        The model of the draws; by default that of the ``with`` block.
    min_observations : int, optional
        Number of observations before the first that is scored, not counting those entirely missing
        or before the variable's ``score_from``.
        At least 1 with `refit`, which needs it, else 0. By default the smallest that leaves only
        reliable scores, which is ``min_observations`` of the result. It must be the same for models
        to be compared: the largest of theirs.
    var_name : str, optional
        Name of the StateSpace variable, if the model has several. Other observed variables count as
        known from the beginning.
    refit : callable, optional
        Returns posterior draws of a copy of the model whose later observations are missing, such as
        ``lambda model: psf.sample_dram(1000, model=model, random_seed=1)``.
    progressbar : bool
        Whether to show how many terms are done, if they take more than two seconds.
    comm
        As in `filtered_states`; None with ``refit``, whose sampler takes it.

    Returns
    -------
    arviz_stats.ELPDDataLFO
        ``elpd`` with ``se``, the sampling error due to the number of observations, not that of the
        computation; ``elpd_i`` and ``pareto_k`` by time; ``refits``; ``p``, the amount by which the
        score is below that with parameters given all observations. ``az.compare`` compares several;
        a result with missing scores raises a `ModelError` there, because a sum over the others
        would favour the model whose scores are missing.

    Raises
    ------
    ModelError
        If `min_observations` leaves nothing to score, or the model has several StateSpace variables
        and `var_name` is not given; further as `compute_log_likelihood`.

    Warns
    -----
    EvidenceWarning
        If some scores are NaN because the weights of the draws are unreliable.

    References
    ----------
    P.-C. Bürkner, J. Gabry and A. Vehtari, "Approximate leave-future-out cross-validation for
    Bayesian time series models", *Journal of Statistical Computation and Simulation* 90 (2020).

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
    >>> record = psf.simulate(system, {"a": 0.8}, steps=range(40), random_seed=1)
    >>> with pm.Model() as model:
    ...     a = pm.Normal("a", 0, 0.5)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=range(40), observed=record["observations"]
    ...     )
    ...     idata = psf.sample_dram(500, tune=500, random_seed=1, progressbar=False)
    ...     score = psf.leave_future_out(idata, min_observations=20)
    >>> score.elpd_i.sizes["d_time"], bool(score.pareto_k.max() < 0.7)
    (20, True)
    """
    model = checked_model(model, idata)
    if refit is not None and comm is not None:
        raise ModelError("comm must be None with refit, whose sampler takes it")
    variable = _one_variable(model, var_name)
    time, name = variable.dims[0], variable.name
    observed = np.flatnonzero(~np.isnan(observed_values(model, name)).all(axis=1))
    observed = observed[observed >= variable.score_from]
    if min_observations is not None or refit is not None:
        _check_min_observations(min_observations, 0 if refit is None else 1, observed.size, name)
    terms = _stored_terms(idata, name)
    if terms is None:
        draws = select_draws(idata, None)
        terms = sequential_terms(model, variable, draws, progressbar=progressbar)
    terms = terms.isel({time: observed})
    if refit is None:
        return _score_by_reweighting(idata, terms, min_observations)
    with warnings.catch_warnings():
        # ArviZ warns of many refits, which are no problem here.
        warnings.filterwarnings("ignore", "LFO-CV triggered")
        return lfo_cv(
            xr.DataTree.from_dict({"log_likelihood": terms.to_dataset(name=name)}),
            _Refits(model, variable, observed, refit, progressbar),
            min_observations,
            forecast_horizon=1,
            time_dim=time,
            pointwise=True,
            k_threshold=largest_good_k(terms.sizes["chain"] * terms.sizes["draw"]),
        )


def _one_variable(model: pm.Model, var_name: str | None) -> StateSpaceVariable:
    variables = select_variables(model, var_name)
    if len(variables) > 1:
        names = [variable.name for variable in variables]
        raise ModelError(f"var_name must be one of {names}, got None")
    if variables[0].is_panel:
        raise ModelError(
            f"the panel {variables[0].name!r} has no common future to leave out: leave out records,"
            " by az.loo after compute_log_likelihood"
        )
    return variables[0]


def _check_min_observations(given: int | None, least: int, n_observations: int, name: str) -> None:
    if not (is_integer(given) and least <= given < n_observations):
        raise ModelError(
            f"min_observations must be an integer from {least} to {n_observations - 1}, as "
            f"{name!r} has {n_observations} observations, got {given!r}"
        )


def _stored_terms(idata: xr.DataTree, name: str) -> xr.DataArray | None:
    """Terms stored by `compute_log_likelihood`, each with the noise of its draw."""
    if "log_likelihood" not in idata.children or name not in idata["log_likelihood"]:
        return None
    terms = idata["log_likelihood"].to_dataset()[name]
    ours = terms.attrs.get("terms") == SEQUENTIAL
    return terms.transpose("chain", "draw", ...) if ours else None


def _score_by_reweighting(
    idata: xr.DataTree, terms: xr.DataArray, min_observations: int | None
) -> ELPDDataLFO:
    """Scores from draws given all observations, reweighted to those given the earlier ones."""
    rows = terms.values.reshape(-1, terms.shape[-1])
    first = min_observations or 0
    scored = rows[:, first:]
    removed = np.cumsum(scored[:, ::-1], axis=1)[:, ::-1]  # log-likelihood of d_j and all later
    efficiency = _efficiency(idata)
    weighted = [smoothed(-column, efficiency) for column in removed.T]
    log_weights, pareto_k = map(np.array, zip(*weighted, strict=True))
    # Equal weights in the tail are those of one point, where a chain rejected.
    pareto_k = np.where(np.isneginf(pareto_k), np.inf, pareto_k)
    good_k = largest_good_k(len(rows))
    known = pareto_k <= good_k
    if min_observations is None and known[-1]:
        first = int(np.append(-1, np.flatnonzero(~known))[-1]) + 1
        known, pareto_k = known[first:], pareto_k[first:]
        scored, log_weights = scored[:, first:], log_weights[first:]
    scores = logsumexp(log_weights + scored.T, axis=1) - logsumexp(log_weights, axis=1)
    elpd_i = np.where(known, scores, np.nan)
    p_i = logsumexp(scored, axis=0) - np.log(len(scored)) - elpd_i
    if not known.all():
        message = _missing(known, good_k, first)
        warn(message, EvidenceWarning)

    def by_time(values: NDArray[np.float64]) -> xr.DataArray:
        time = terms.dims[-1]
        coords = {time: terms[time][first:]} if time in terms.coords else {}
        return xr.DataArray(values, dims=[time], coords=coords)

    complete = bool(known.all())
    return (ELPDDataLFO if complete else IncompleteScores)(
        elpd=float(elpd_i.sum()),
        se=float(np.sqrt(elpd_i.size) * elpd_i.std()),
        p=float(p_i.sum()),
        n_samples=len(rows),
        n_data_points=elpd_i.size,
        scale="log",
        warning=not complete,
        good_k=good_k,
        elpd_i=by_time(elpd_i),
        pareto_k=by_time(pareto_k),
        forecast_horizon=1,
        min_observations=first,
        refits=np.array([], dtype=int),
        n_refits=0,
        p_lfo_i=by_time(p_i),
    )


def _efficiency(idata: xr.DataTree) -> float:
    """Effective over actual number of draws, averaged over the parameters."""
    posterior = idata["posterior"].to_dataset()
    n_draws = posterior.sizes["chain"] * posterior.sizes["draw"]
    sizes = ess(posterior, method="mean")
    return float(np.nanmean(np.concatenate([np.ravel(v) for v in sizes.values()])) / n_draws)


def _missing(known: NDArray[np.bool_], good_k: float, min_observations: int) -> str:
    """Say which scores are missing, why, and what would give them."""
    n_missing, last_unknown = int(np.sum(~known)), int(np.flatnonzero(~known)[-1])
    least = min_observations + last_unknown + 1
    remedy = f"set min_observations={least}, or " if last_unknown < known.size - 1 else ""
    return (
        f"{n_missing} of the {known.size} scores are NaN, as is their sum, because the "
        f"weights of the draws are unreliable (Pareto k above {good_k:.2f}): {remedy}give refit= "
        "to sample the posteriors given fewer observations"
    )


class IncompleteScores(ELPDDataLFO):
    """Scores of which some are NaN, because the draws do not determine them.

    ``az.compare`` asks every result for its ``kind`` before it computes anything. Otherwise it
    would end in an error about NaN, or give weights without meaning.
    """

    @property
    def kind(self) -> str:
        """Raise, with what would complete the scores."""
        known = (self.pareto_k <= self.good_k).values
        time = self.pareto_k.dims[0]
        first = self.pareto_k[time].values[~known][:5].tolist()
        raise ModelError(
            f"scores cannot be compared while some are missing ({time} "
            f"{', '.join(map(str, first))}{', ...' if (~known).sum() > 5 else ''}): "
            f"{_missing(known, self.good_k, self.min_observations)}. All models need the same "
            "min_observations"
        )


class _Refits(SamplingWrapper):
    """ArviZ's interface to a model that is fitted repeatedly."""

    def __init__(
        self,
        model: pm.Model,
        variable: StateSpaceVariable,
        observed: NDArray[np.int64],
        refit: Refit,
        progressbar: bool,
    ) -> None:
        super().__init__(model)
        self._variable, self._observed, self._refit = variable, observed, refit
        self._progressbar = progressbar

    def sel_observations(self, idx: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
        """The first row that is left out, and all rows that are."""
        left_out = self._observed[idx]
        return int(left_out[0]), left_out

    def sample(self, modified_observed_data: int) -> xr.DataTree:
        """Posterior draws given the rows before `modified_observed_data`."""
        return self._refit(truncate_data(self.model, self._variable.name, modified_observed_data))

    def get_inference_data(self, fitted_model: xr.DataTree) -> xr.DataTree:
        """The draws themselves: `refit` returns a DataTree."""
        return fitted_model

    def log_likelihood__i(
        self, excluded_obs: NDArray[np.int64], idata__i: xr.DataTree
    ) -> xr.DataArray:
        """Terms of later rows, with the noise of each draw."""
        draws, bar = select_draws(idata__i, None), self._progressbar
        terms = sequential_terms(self.model, self._variable, draws, progressbar=bar)
        return terms.isel({self._variable.dims[0]: excluded_obs})


def observed_values(model: pm.Model, name: str) -> NDArray[np.float64]:
    """The observations (J, p) of a StateSpace variable."""
    return np.asarray(model.rvs_to_values[model[name]].eval(mode="FAST_COMPILE"), np.float64)


def truncate_data(model: pm.Model, name: str, n_rows: int) -> pm.Model:
    """Copy a model, keeping only the first `n_rows` observations of a StateSpace variable.

    The later rows are set to missing, so that dimensions, coordinates and noise seeds stay, and an
    estimate uses the same noise as one from all observations at the same seed.
    """
    observed = observed_values(model, name)
    observed[n_rows:] = np.nan
    graph, copies = fgraph_from_model(model)
    node = copies[model[name]].owner
    _, old = node.inputs
    new = old.type.filter_variable(pt.as_tensor(observed))
    graph.change_node_input(node, 1, new, import_missing=True)
    return model_from_fgraph(graph, mutate_fgraph=True)
