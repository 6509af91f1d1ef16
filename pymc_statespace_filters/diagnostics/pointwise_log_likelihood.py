"""Sequential log-likelihood terms at every draw, each with the noise of its own estimate."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.state_graphs import StateSpaceVariable
from pymc_statespace_filters.states.draws import PosteriorDraws, select_draws
from pymc_statespace_filters.states.groups import add_group
from pymc_statespace_filters.states.variable import VariableAtDraws, select_variables

SEQUENTIAL = (
    "log p(d_j | d_1 .. d_{j-1}, theta): each term is conditional on all earlier observations. "
    "Leave-one-out cross-validation (az.loo) is invalid with such terms, because later terms "
    "depend on the observation left out; use leave_future_out."
)


def compute_log_likelihood(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    r"""Evaluate the log-likelihood terms at every draw, with the draw's own noise.

    The terms :math:`\log p(d_j \mid d_1 \dots d_{j-1}, \theta)` are **sequential**: each is
    conditional on all earlier observations. `leave_future_out` uses them. ``az.loo``, and with it
    ``az.compare`` of DataTrees, is invalid with them, because the terms of later observations
    depend on the observation that is left out. ArviZ does not warn; ``elpd_i`` of its pointwise
    result has the attribute ``terms``, which says so.

    The likelihood by a particle or ensemble filter is an estimate that depends on a noise seed.
    `sample_dram` stores the seed of each draw, and with it the terms add up to the estimate by
    which the draw was accepted. (``pm.compute_log_likelihood`` uses the seed held by the model for
    all draws, and so gives other estimates.)

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws. If ``sample_stats`` holds no seeds, the seed of the model is used.
    model, var_name, progressbar
        As in `filtered_states`.
    extend_inferencedata : bool
        Whether to add the terms to the group of `idata`, beside those of other variables; otherwise
        the group is returned in a new DataTree.

    Returns
    -------
    xarray.DataTree
        With the group ``log_likelihood``: for a variable "d" its terms ``d`` (chain, draw, d_time),
        0 for an observation that is entirely missing or before ``score_from``, -inf from a failure
        of the filter on. The attribute ``terms`` says that they are sequential.

    Raises
    ------
    ModelError
        If draws and model are inconsistent, or the chain moved its noise (``correlation``), so that
        no seed reproduces the estimates.

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
    ...         "d", system, psf.BootstrapPF(50), steps=[0, 1, 2], observed=[0.3, 1.2, 0.4]
    ...     )
    ...     idata = psf.sample_dram(100, tune=100, chains=2, random_seed=1, progressbar=False)
    ...     terms = psf.compute_log_likelihood(idata)["log_likelihood"]["d"]
    >>> dict(terms.sizes)
    {'chain': 2, 'draw': 100, 'd_time': 3}
    """
    model = pm.modelcontext(model)
    draws = select_draws(idata, None)
    found = xr.merge(
        [
            sequential_terms(model, variable, draws, progressbar=progressbar).to_dataset()
            for variable in select_variables(model, var_name)
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
    """The terms (chain, draw, time) of one variable at draws, with the noise of each.

    They are evaluated at the stored, constrained values, so that the estimates of the chain are
    reproduced to the last digit.
    """
    name, noisy = variable.name, variable.filter.noisy
    if noisy and draws.noise_moved:
        raise ModelError(
            f"the noise of {name!r} was moved along the chain (correlation), so that no seed "
            "reproduces the estimates of these draws: sample without correlation"
        )
    at_draws = VariableAtDraws(model, variable, draws)
    seeds = draws.stored_seeds(name) if noisy else None
    if seeds is None:  # use the model's seed; a deterministic filter ignores it
        held = variable.seed.eval(mode="FAST_COMPILE")
        seeds = np.full(np.prod(draws.shape), held, dtype=np.int64)
    seed = pt.lscalar("seed")
    node = model[name].owner
    with_seed = node.clone_with_new_inputs([*node.inputs[:-1], seed]).default_output()
    graph = pm.logp(with_seed, variable.observed, warn_rvs=False)
    (terms,) = at_draws.evaluate(
        [graph], {seed: seeds}, task=f"terms of {name}", progressbar=progressbar
    )
    time = variable.dims[0]
    found = draws.dataset({name: ((time,), terms)}, {time: at_draws.times(at_draws.steps)})[name]
    return found.assign_attrs(terms=SEQUENTIAL)
