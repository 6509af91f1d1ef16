"""The public function: a scan for the parameter that varies, and for the time."""

from collections.abc import Iterable
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...compiler.native.compilation import COMPILATION
from ...errors import ModelError
from ...progress import row_progress
from ...pymc_model.inspection import given_model
from ...pymc_model.posterior_draws import unconstrained_draws
from ...pymc_model.term_scores import ScoredVariable
from ...states.variable import select_variables
from ...system.checks import check_count, check_random_seed
from .statistics import ConstancyTest
from .table import TimeAxis, scan_table

N_TRIED = 64  # draws, of which the best is where the search of the mode begins
FEWEST = 19  # simulated data sets

Array = NDArray[np.float64]


@runtime_checkable
class PointEstimate(Protocol):
    """A point of the unconstrained space, as `maximum_likelihood` returns it."""

    unconstrained: np.ndarray


def drift_scan(
    idata: xr.DataTree | PointEstimate,
    model: pm.Model | None = None,
    *,
    var_name: str | None = None,
    parameters: str | Iterable[str] | None = None,
    n_simulated: int = 499,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> pd.DataFrame:
    r"""Scan a model of constant parameters for those that vary in time, and when.

    For each parameter the scores, the derivatives of the terms
    :math:`\log p(d_j | d_1 \dots d_{j-1})` with respect to it, are summed along the record.
    The sum of a constant parameter wanders about zero; where the parameter changes the sum turns.
    Nyblom's statistic measures that. It needs no chains of a drifting model.

    Parameters
    ----------
    idata : xarray.DataTree or MaximumLikelihoodEstimate
        Posterior draws of the model, or the result of `maximum_likelihood`: where the search of the
        posterior mode begins, which is found for the data as for each simulated data set.
    model : pymc.Model, optional
        Model of the data with constant parameters and the filter `EKF`, `UKF` or `IPLF`; by default
        that of the ``with`` block.
    var_name : str, optional
        Name of the StateSpace variable, if there are several.
    parameters : str or iterable of str, optional
        Parameters of the system, or elements such as ``"A[0, 1]"``. By default all that depend on
        free variables, except those of the start alone. Those that are fixed at numbers can be
        named, too. Left out are those without an effect at the estimate, as a noise at zero.
    n_simulated : int
        Number of simulated data sets, at least 19; a p-value is a multiple of 1 / (n_simulated +
        1).
    random_seed : int or numpy.random.Generator, optional
        Of the simulated data sets.
    progressbar : bool
        Whether to show a progress bar if the evaluations take more than two seconds.

    Returns
    -------
    pandas.DataFrame
        A row for each parameter, most suspicious first. Index ``parameter``; columns:

        ``p_value``
            Probability of a statistic as suspicious in any of the scanned parameters, if all are
            constant.
        ``p_alone``
            The same of this parameter alone.
        ``statistic``
            Nyblom's, the mean over time of the squares of the summed scores minus the curvature
            that belongs to them, in standard deviations from the mean of the simulated data sets.
        ``record``
            In a panel, the record of that jump.
        ``time``, ``change``
            Where the parameter changes most likely if it jumps once, the time of the first row
            after that, and by how much; to first order in the change.

        Its attribute ``paths`` has the sums; `plot_drift` draws them.

    Raises
    ------
    ModelError
        If an argument is invalid, the filter is another one, or the model has no likelihood at most
        of the simulated data sets.
    DataMismatchError
        If the draws belong to another model.

    Notes
    -----
    The likelihood is even in the strength of a random walk of a parameter, so that the test is of
    the derivative by its *square*, which is not negative: it is the locally most powerful one. The
    data sets are simulated with the system, not with the filter, so that a filter that is only
    nearly right gives the right p-values. They hold for records that are long enough for estimates
    to be nearly normal.

    In a panel each record has its own path.

    A change of one parameter also changes the sums of parameters whose scores are correlated with
    its own, but less: consider the first row first. Where another statistic is half as large or
    more, the scan cannot tell both apart; the evidences of a model of `drifting` for each can. A
    large change of a parameter leaves large residuals, so that a noise parameter may seem to vary
    as well.

    References
    ----------
    J. Nyblom (1989). Testing for the constancy of parameters over time. Journal of the American
    Statistical Association 84, 223-230.

    P. H. Westfall and S. S. Young (1993). Resampling-based multiple testing. Wiley.

    Examples
    --------
    A gain that rises in mid-record:

    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, u, a, gain: [a * x[0] + gain * u[0] + q[0]],
    ...     process_noise=[[0.1]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ...     inputs=["force"],
    ... )
    >>> rng = np.random.default_rng(1)
    >>> force, observed, x = rng.normal(size=(101, 1)), [], 0.0
    >>> for k in range(101):
    ...     observed.append(x + 0.3 * rng.normal())
    ...     x = 0.5 * x + (1.0 if k < 60 else 1.5) * force[k, 0] + 0.3 * rng.normal()
    >>> with pm.Model():
    ...     a, gain = pm.Uniform("a", -1, 1), pm.Normal("gain", 0, 2)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=range(101), inputs=force, observed=observed
    ...     )
    ...     estimate = psf.maximum_likelihood(random_seed=1, progressbar=False)
    ...     scan = psf.diagnostics.drift_scan(
    ...         estimate, n_simulated=199, random_seed=2, progressbar=False
    ...     )
    >>> scan.index[0], bool(scan["p_value"].iloc[0] < 0.02), int(scan["time"].iloc[0])
    ('gain', True, 63)
    """
    model = given_model(model)
    n_simulated = check_count("n_simulated", n_simulated, FEWEST)
    rng = check_random_seed(random_seed)
    name = _variable_name(model, var_name)
    with COMPILATION:
        variable = ScoredVariable(model, name)
        axis = TimeAxis.of(model, variable)
        test = ConstancyTest(variable, axis.durations, _start(idata, model, variable))
        chosen, left_out = _chosen(test, parameters)
        with row_progress(test, enabled=progressbar) as announce:
            announce("simulated data sets", n_simulated)
            found = test.run(chosen, n_simulated, rng)
    labels = variable.labels
    return scan_table(found, [labels[i] for i in chosen], axis, [labels[i] for i in left_out])


def _variable_name(model: pm.Model, var_name: str | None) -> str:
    names = [variable.name for variable in select_variables(model, var_name)]
    if len(names) > 1:
        raise ModelError(f"var_name must name one of the StateSpace variables {names}, got None")
    return names[0]


def _start(idata: Any, model: pm.Model, variable: ScoredVariable) -> Array:
    """The point (k_x,) where the search of the posterior mode begins."""
    if isinstance(idata, PointEstimate):
        return np.asarray(idata.unconstrained, dtype=np.float64)
    draws = unconstrained_draws(idata, model)
    draws = draws.reshape(-1, draws.shape[-1])
    tried = draws[np.linspace(0, len(draws) - 1, min(N_TRIED, len(draws))).astype(int)]
    observed = np.repeat(variable.observed[None], len(tried), axis=0)
    value = variable.other_density(tried)
    value = value + variable.terms(variable.theta(tried), observed).sum(axis=1)
    return np.asarray(tried[np.nanargmax(value)])


def _chosen(
    test: ConstancyTest, parameters: str | Iterable[str] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers of the elements of theta that are scanned, and of those without an effect."""
    variable, labels = test.variable, test.variable.labels
    after_start = variable.act_after_start
    if parameters is None:
        return _with_effect(test, np.flatnonzero(test.moving() & after_start))
    names = [parameters] if isinstance(parameters, str) else list(parameters)
    owners = [label.split("[")[0] for label in labels]
    if unknown := [name for name in names if name not in [*labels, *owners]]:
        raise ModelError(f"parameters must be some of {labels}, got {unknown}")
    pairs = zip(labels, owners, strict=True)
    named = np.array([label in names or owner in names for label, owner in pairs])
    if at_start := [labels[i] for i in np.flatnonzero(named & ~after_start)]:
        raise ModelError(
            f"parameters must act after the start of a record, got {at_start}: the equations of "
            "the steps and of the sensor do not use them"
        )
    return _with_effect(test, np.flatnonzero(named))


def _with_effect(
    test: ConstancyTest, chosen: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    has_effect = test.has_effect()[chosen]
    if not has_effect.any():
        raise ModelError(
            "parameters must name what is scanned: no parameter of the system depends on a free "
            "variable, acts after the start of a record, and has an effect on the likelihood at "
            f"the estimate; there are {test.variable.labels}"
        )
    return chosen[has_effect], chosen[~has_effect]
