"""The terms of a record's log-likelihood at every draw, each with the noise of its own estimate."""

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
    "Leave-one-out cross-validation (az.loo) on such terms is not leave-one-out, for a left-out "
    "observation would still be known to the terms of later ones; leave_future_out is what they "
    "are for."
)


def compute_log_likelihood(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> xr.DataTree:
    r"""Evaluate the terms of the log-likelihood at every draw, with the draw's own noise.

    The terms :math:`\log p(d_j \mid d_1 \dots d_{j-1}, \theta)` are **sequential**: each knows all
    earlier observations. They are what `leave_future_out` needs. ``az.loo`` on them is not
    leave-one-out cross-validation: it would weight draws as if one term held all that an
    observation says, while the later terms go on knowing it.

    The likelihood by a particle or ensemble filter is an estimate, which depends on a noise seed.
    `sample_dram` stores the seed of each draw, and with it the terms add up to the estimate by
    which the draw was accepted. (``pm.compute_log_likelihood`` gives all draws the one seed that
    the model holds: other estimates than those that the draws follow.)

    Parameters
    ----------
    idata : xarray.DataTree
        Draws of the posterior. Where ``sample_stats`` holds no seeds, they were drawn with the
        model's own.
    model : pymc.Model, optional
        The model of the ``with`` block if not given.
    var_name : str, optional
        A StateSpace variable; all of the model's if not given.
    extend_inferencedata : bool
        Whether `idata` gets the group, beside the terms of other variables that it has there;
        otherwise a new DataTree has it alone.
    progressbar : bool
        Whether work of more than two seconds shows a bar.

    Returns
    -------
    xarray.DataTree
        With the group ``log_likelihood``: for a variable "d" its terms ``d`` (chain, draw, d_time),
        0 where a row of the record is wholly missing, minus infinity from a failing observation on.
        The attribute ``terms`` says that they are sequential.

    Raises
    ------
    ModelError
        If draws and model do not fit together; or if the noise was moved along the chain
        (``correlation``), so that no seed gives the estimates again: sample without, for terms.

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

    They are a function of the values that a posterior stores, not of unconstrained ones, so that
    every digit of an estimate comes again.

    Raises
    ------
    ModelError
        As `compute_log_likelihood`.
    """
    name, noisy = variable.name, variable.filter.noisy
    if noisy and draws.noise_moved:
        raise ModelError(
            f"the noise of {name!r} was moved along the chain (correlation), so that no seed gives "
            "the estimates of these draws again: for terms sample without correlation"
        )
    at_draws = VariableAtDraws(model, variable, draws)
    seeds = draws.own_seeds(name) if noisy else None
    if seeds is None:  # held, or not read
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
