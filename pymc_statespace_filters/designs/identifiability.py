"""`identifiability`: what the records of a model's design can say about its parameters."""

from collections.abc import Iterable
from math import ceil
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..compiler.native.compilation import COMPILATION
from ..errors import ModelError
from ..progress import row_progress
from ..pymc_model.checked_model import checked_model
from ..pymc_model.density import check_free_variables
from ..pymc_model.elements import Elements
from ..pymc_model.inspection import given_model
from ..pymc_model.posterior_draws import unconstrained_draws
from ..pymc_model.prior import ModelPrior
from ..system.checks import check_count, check_random_seed
from .dummy_data import with_dummy_data
from .fisher_information import (
    Coordinates,
    Likelihood,
    expected_posterior,
    normal_covariance,
    spread,
)
from .full_posteriors import FullPosterior
from .identifiability_table import Expected, Identifiability, table_of

N_PRIOR = 4000  # draws, for the covariance of the prior
LEAST_ROWS, ROWS_OF_PARAMETER = 500, 50  # rows of all simulated records of a point
LEAST_LEFT = 0.25  # share of the points that must have a likelihood
N_FULL = 6  # full posteriors
SINGULAR = 1e-12  # eigenvalue of the prior's correlations, next to rounding

Array = NDArray[np.float64]


def identifiability(
    model: pm.Model | None = None,
    *,
    idata: xr.DataTree | None = None,
    var_names: str | Iterable[str] | None = None,
    n_draws: int = 100,
    n_records: int | None = None,
    random_seed: Any = None,
    progressbar: bool = True,
) -> Identifiability:
    r"""What a record of the model's design can say: the expected posterior beside the prior.

    Before there are data, or at a fit. The records are those of the model's `StateSpace` variables,
    with their times, inputs, events, missing values and panels; their data are not used.

    Parameters
    ----------
    model : pymc.Model, optional
        With `StateSpace` variables, observed or not, whose filters have a gradient. Default: the
        model of the ``with`` block.
    idata : xarray.DataTree, optional
        Draws of the posterior. The points are then some of these, and the answer is about a fresh
        record of this design, alone with the prior, if parameters are as they were found. Default:
        draws of the prior.
    var_names : str or sequence of str, optional
        Free variables, or elements such as ``"k[2]"``, that get a row. The others are unknown, too.
    n_draws : int
        Points at which records are simulated, at least 2.
    n_records : int, optional
        Simulated records at each point. Default: so many that they have 500 rows, and 50 for each
        parameter.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool

    Returns
    -------
    Identifiability
        A DataFrame with a row for each element of a free variable, named as by ArviZ, and below it
        sentences about what is hardly determined. Columns:

        ``ratio``
            Mean over the points of the sd of the posterior over that of the prior.
        ``se``
            Its standard error over the points.
        ``q05``, ``q95``
            Quantiles of the ratio over the points.
        ``coordinate``
            What the sds are of: ``"log"``, the logarithm of a positive parameter, so that an sd of
            0.02 is 2 %; ``"value"``, the parameter; or ``"unconstrained"``, of an element of a
            variable that its transform shortens, such as a simplex.
        ``prior_sd``, ``posterior_sd``
            In this coordinate; of the posterior the mean.
        ``full_ratio``
            The ratio by full posteriors of a few records; NaN if most of them failed.

        The attribute ``directions`` has the weak directions, and ``combinations`` what is
        determined in them.

    Raises
    ------
    ModelError
        If an argument is invalid; if there is no `StateSpace` variable, one has censored data, or a
        filter without gradient; if the prior is improper; or if simulated records have no
        likelihood at most of the points.
    DataMismatchError
        If the draws belong to another model.

    Notes
    -----
    At each point the covariance of the posterior is :math:`(F + S^{-1})^{-1}`, with the expected
    Fisher information F of the record and the covariance S of the prior. F is the mean over
    simulated records of the sum of products :math:`g_j g_j^T` of the scores of rows given the rows
    before, which has the mean of the product of their sums with a smaller variance.

    S has the correlations of normal scores of draws of the prior. An sd is half the width of the
    central 68 % interval, which is that of a normal law, so that heavy tails do not count. A prior
    whose width depends on another parameter, as in a hierarchical model, is taken as the normal law
    of this covariance.

    That the posterior is normal is compared with the full posteriors of six records, by importance
    sampling; a sentence says where their ratio is another one.

    A direction is weak if half of the prior's sd remains along it. Combinations of up to three weak
    parameters are tried: powers up to two of positive ones, multiples up to two of others. Other
    observed variables of the model, and potentials, are not used.

    References
    ----------
    M. K. Transtrum, B. B. Machta and J. P. Sethna (2011). Geometry of nonlinear least squares with
    applications to sloppy models and optimization. Physical Review E 83, 036701.

    Examples
    --------
    A population far below its capacity K:

    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> growth = psf.StateSpaceModel(
    ...     psf.RungeKutta4(lambda x, r, K: [r * x[0] * (1 - x[0] / K)], dt=0.1),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_mean=[1.0],
    ...     initial_cov=0.0,
    ... )
    >>> with pm.Model():
    ...     r, K = pm.LogNormal("r", 0, 0.5), pm.LogNormal("K", 7, 1)
    ...     psf.StateSpace("d", growth, psf.EKF(), times=[0.5, 1.0, 1.5, 2.0])
    ...     found = psf.identifiability(random_seed=1, progressbar=False)
    d
    >>> bool(found["ratio"]["r"] < 0.2), bool(found["ratio"]["K"] > 0.8)
    (True, True)
    """
    given = given_model(model)
    n_draws = check_count("n_draws", n_draws, 2)
    if n_records is not None:
        n_records = check_count("n_records", n_records, 1)
    rng = check_random_seed(random_seed)
    own = with_dummy_data(given)
    check_free_variables(own)
    elements = Elements.of(own)
    chosen = _chosen(elements, var_names)
    with COMPILATION:
        prior = ModelPrior(own).sample(N_PRIOR, rng)
        sd, coordinates = spread(prior), Coordinates(own)
        likelihood = Likelihood(own, sd)
        full = FullPosterior(own, likelihood, coordinates, sd)
    x = prior[:n_draws] if idata is None else _posterior_points(given, own, idata, n_draws)
    rows = max(LEAST_ROWS, ROWS_OF_PARAMETER * len(sd))
    n_records = ceil(rows / likelihood.n_rows) if n_records is None else n_records
    cov, covs, kept = normal_covariance(coordinates(prior)), [], []
    _check_prior(cov, elements)
    with row_progress(likelihood, enabled=progressbar) as announce:
        announce("simulated records", len(x) * n_records)
        for point in x:
            information = likelihood.information(point, n_records, rng)
            if information is not None:
                inverse = np.linalg.inv(coordinates.jacobian(point[None], sd)[0])
                covs.append(expected_posterior(cov, inverse.T @ information @ inverse))
                kept.append(point)
        if len(kept) < max(2, LEAST_LEFT * len(x)):
            raise ModelError(
                "simulated records must be finite and have a likelihood by the filter at a quarter "
                f"of the points, got {len(kept)} of {len(x)}: give the model a prior with less "
                "mass where its equations have no solution"
            )
        announce("full posteriors", N_FULL)
        pairs = zip(kept[:N_FULL], covs, strict=False)
        full_sds = [full.spread(point, one, rng) for point, one in pairs]
    where = "prior" if idata is None else "posterior"
    sentences = [
        "ratio is the expected sd of the posterior over that of the prior, for records simulated "
        f"at {len(kept)} draws of the {where}."
    ]
    if len(kept) < len(x):
        sentences.append(
            f"{len(x) - len(kept)} further draws are left out: records simulated there are not "
            "finite, or have no likelihood by the filter."
        )
    known = {variable.name for variable in likelihood.variables}
    others = [v.name for v in [*own.observed_RVs, *own.potentials] if v.name not in known]
    if others:
        sentences.append(f"Not used are other data and potentials of the model: {others}.")
    expected = Expected(list(elements.labels), coordinates.kinds, cov, np.array(covs), full_sds)
    return table_of(expected, chosen, sentences)


def _chosen(elements: Elements, var_names: str | Iterable[str] | None) -> NDArray[np.int64]:
    if var_names is None:
        return np.arange(len(elements.labels))
    names = [var_names] if isinstance(var_names, str) else list(var_names)
    if not names:
        raise ModelError("var_names must name at least one free variable, got none")
    columns = [column for name in names for column in elements.columns(name, "var_names")]
    return np.array(list(dict.fromkeys(columns)))


def _check_prior(cov: Array, elements: Elements) -> None:
    """Raise if the prior gives a parameter as a function of others."""
    sd = np.sqrt(np.diagonal(cov))
    shares, axes = np.linalg.eigh(np.nan_to_num(cov / np.outer(sd, sd)))
    if shares[0] < SINGULAR:
        labels = [str(elements.labels[i]) for i in np.flatnonzero(np.abs(axes[:, 0]) > 0.1)]
        raise ModelError(
            f"free variables must not be functions of each other in the prior, got {labels}: make "
            "one of them a pm.Deterministic"
        )


def _posterior_points(model: pm.Model, own: pm.Model, idata: Any, n_draws: int) -> Array:
    checked_model(model, idata, any_filter=True)
    draws = unconstrained_draws(idata, own)
    draws = draws.reshape(-1, draws.shape[-1])
    return np.asarray(draws[np.linspace(0, len(draws) - 1, n_draws).astype(int)])
