"""``suggest_particles``: how many particles the estimated likelihood of a model needs."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from pymc.model import Model

from ..errors import ModelError
from ..facts import Fact, tell
from ..filters.written import short_form
from ..former_names import former_names
from ..progress import row_progress
from ..pymc_model.aligned_axes import records_of_rows
from ..pymc_model.checked_model import checked_model
from ..pymc_model.density import RowFunction, check_free_variables
from ..pymc_model.graph_rewrites import with_filter
from ..pymc_model.inspection import (
    given_model,
    log_density_terms,
    noisy_filters,
    resized,
    state_space_nodes,
)
from ..pymc_model.other_filter import model_with_filters
from ..pymc_model.panel_structure import panel_structure
from ..pymc_model.posterior_draws import unconstrained_draws
from ..system.checks import check_random_seed
from .kernel.state import draw_seeds
from .output.likelihood_variance import TARGET
from .starts.population import population_of

# Of the search for draws: points, and particles with which it is neither led by noise nor slow.
_N_POINTS, _IN_SEARCH = 32, (200, 1000)
_N_MEASURED, _N_SEEDS = 12, 12  # points of the posterior, and estimates at each
_LEAST = 10  # particles
_STEP = 16.0  # most by which the second number differs from the first
_GROWTH = 2.0  # of N times the variance, up to which that falls about as 1/N
_SMALLEST = 1e-12  # variance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SlowVariance(Fact):
    """A variable whose estimates have a variance that does not fall as 1/N."""

    model: Model
    name: str
    measured: str


class _Measured(NamedTuple):
    n_particles: int
    variance: float  # infinity if most of the estimates fail

    def __str__(self) -> str:
        return f"{self.variance:.2g} with {self.n_particles} particles"


@former_names
def suggest_particles(
    model: Model | None = None,
    *,
    idata: xr.DataTree | None = None,
    target: tuple[float, float] = TARGET,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> pd.DataFrame:
    """Find the number of particles at which a chain gains most per unit of time.

    At twelve draws of the posterior the log-likelihood is estimated with twelve noise seeds each.
    Its variance is about proportional to 1/N for N particles. It is measured again with the number
    that should bring it into the target.

    Parameters
    ----------
    model : pymc.Model, optional
        Default: the model of the ``with`` block. It has noisy filters, and continuous free
        variables.
    idata : xarray.DataTree, optional
        Draws of its posterior, by any filter. Default: those of a small search such as
        `find_starts` makes.
    target : (float, float), default (1.0, 3.3)
        Range for the variance of the estimated log-likelihood. Per unit of time chains gain most
        between 1 and 3.3 [1]_, [2]_. Several noisy variables have equal shares of it. In a panel
        whose records share no parameter, `sample_dram` accepts each record by its own likelihood,
        and the range is that of the record with the largest variance; with shared parameters it is
        that of the sum.
    random_seed : None, int or numpy.random.Generator
    progressbar : bool
        Whether to show the progress, if it takes longer than two seconds.

    Returns
    -------
    pandas.DataFrame
        A row for each noisy variable, indexed by ``variable``:

        ``filter``
            as it is in the model
        ``variance``
            of the estimated log-likelihood with this filter, the median of the draws; infinite if
            most estimates fail
        ``low``, ``high``
            the range for the variable
        ``n_particles``
            the number to take; missing if no number can be named
        ``reason``
            what has been measured, in words

    Raises
    ------
    ModelError
        If an argument is not as described, the model has no noisy variable or a discrete free
        variable, or the search for draws fails, as with an improper prior.
    DataMismatchError
        If idata does not belong to the model.

    Warns
    -----
    FilterWarning
        If the variance does not fall as 1/N: particles collapse at some observation.

    Notes
    -----
    The search makes 1000 to 2500 evaluations, with 200 to 1000 particles. The second number is at
    most 16 times the first, or a sixteenth of it. If its variance lies outside the range, the
    number named is interpolated, or extrapolated by 1/N; it is at least 10. Its variance has an
    error of a fifth or so, and the range is wider.

    For EnKF and PFEnKF the number of members also changes the bias, of which a small variance says
    nothing: see `check_filter`.

    References
    ----------
    .. [1] A. Doucet and others (2015). Biometrika 102, 295-313.
    .. [2] C. Sherlock and others (2015). Annals of Statistics 43, 238-275.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> record = psf.simulate(system, {"a": 0.8}, steps=range(1, 41), random_seed=1)
    >>> with pm.Model() as model:
    ...     a = pm.Normal("a", 0, 1)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.BootstrapPF(200), steps=range(1, 41),
    ...         observed=record["observations"],
    ...     )
    >>> table = psf.suggest_particles(model, random_seed=1)
    >>> better = psf.BootstrapPF(table.loc["d", "n_particles"])
    >>> 20 < better.n_particles < 100
    True
    """
    model = given_model(model)
    filters: dict[str, Any] = noisy_filters(model)
    if not filters:
        raise ModelError(
            "model must have a StateSpace variable with a noisy likelihood (particles or an "
            "ensemble), got a model without one"
        )
    check_free_variables(model)
    low, high = (end / len(filters) for end in _checked_target(target))
    rng = check_random_seed(random_seed)
    if idata is None:
        moderate = {
            name: resized(filter, int(np.clip(filter.size(), *_IN_SEARCH)))
            for name, filter in filters.items()
        }
        model = model_with_filters(model, moderate)  # whose coordinates have an order of its own
        points = population_of(model, rng, progressbar=progressbar, n_points=_N_POINTS)[0].x
    else:
        checked_model(model, idata, any_filter=True)
        points = np.concatenate(unconstrained_draws(idata, model))
    chosen = points[np.linspace(0, len(points) - 1, _N_MEASURED).astype(int)]
    measure = partial(_measured, model, x=chosen, rng=rng, progressbar=progressbar)
    first = measure(filters)
    numbers = {name: _second_number(measured, low, high) for name, measured in first.items()}
    others = {name: resized(filter, numbers[name]) for name, filter in filters.items()}
    second = first if others == filters else measure(others)
    rows = []
    for name, filter in filters.items():
        n_particles, reason = _suggestion(first[name], second[name], low, high)
        if n_particles is None:
            tell(SlowVariance(model, name, reason))
        found = first[name].variance, low, high, n_particles, reason
        rows.append((name, short_form(filter), *found))
    columns = ["variable", "filter", "variance", "low", "high", "n_particles", "reason"]
    table = pd.DataFrame(rows, columns=columns).set_index("variable")
    return table.astype({"n_particles": "Int64"})  # which may be missing


def _measured(
    model: Model,
    filters: Mapping[str, Any],
    x: Array,
    rng: np.random.Generator,
    *,
    progressbar: bool,
) -> dict[str, _Measured]:
    """The variances of the log-likelihoods of noisy variables at points (m, d), by new filters."""
    terms = dict(log_density_terms(model))
    graphs = with_filter([terms[name] for name in filters], model, filters)
    total: Any = sum(graph.sum() for graph in graphs)
    calls = RowFunction(model, total, graphs).calls
    seeds = draw_seeds(rng, (len(x) * _N_SEEDS, len(filters)))
    with row_progress(calls, enabled=progressbar) as announce:
        announce("Estimating the variance", len(seeds))
        _, *estimates = calls(np.repeat(x, _N_SEEDS, axis=0), *seeds.T)
    starts = _records_moved_alone(model)
    return {
        name: _Measured(filter.size(), _variance(of_variable, starts.get(name, np.array([0]))))
        for (name, filter), of_variable in zip(filters.items(), estimates, strict=True)
    }


def _variance(terms: Array, starts: NDArray[np.int64]) -> float:
    """The median over points, from terms (m * seeds, J); of records, by their starts, the largest.

    Infinite if half of the estimates at half of the points fail.
    """
    sums = np.add.reduceat(terms, starts, axis=1).reshape(-1, _N_SEEDS, starts.size)
    is_known = np.isfinite(sums)
    variances = np.ma.array(sums, mask=~is_known).var(axis=1, ddof=1).filled(np.inf)
    variances[is_known.mean(axis=1) <= 0.5] = np.inf
    return float(np.median(variances, axis=0).max())


def _records_moved_alone(model: Model) -> dict[str, NDArray[np.int64]]:
    """The first row of each record of a panel variable, if no move of a chain needs all records."""
    structure = panel_structure(model)
    if structure is None or structure.shared:
        return {}
    rows = state_space_nodes(model)[structure.name].inputs[3]
    return {structure.name: np.unique(records_of_rows(rows), return_index=True)[1]}


def _second_number(measured: _Measured, low: float, high: float) -> int:
    """The number that should have a variance in the range, not too far from the first."""
    if low <= measured.variance <= high:
        return measured.n_particles
    factor = float(np.clip(measured.variance / math.sqrt(low * high), 1 / _STEP, _STEP))
    return _rounded(factor * measured.n_particles)


def _suggestion(
    first: _Measured, second: _Measured, low: float, high: float
) -> tuple[int | None, str]:
    """A number of particles whose variance lies in the range, and why; None if there is none.

    Between two measurements the variance is a power of the number, and beyond them that is -1.
    """
    if second.n_particles == first.n_particles:
        return first.n_particles, f"the variance is {first}"
    found = f"the variance is {first} and {second}"
    if low <= second.variance <= high:
        return second.n_particles, found
    if first.variance < low and math.isinf(second.variance):
        return first.n_particles, found
    more = second.n_particles / first.n_particles
    ratio = max(second.variance, _SMALLEST) / max(first.variance, _SMALLEST)
    if min(first.variance, second.variance) > high and not ratio * more <= _GROWTH:
        return None, f"{found}: particles collapse at some observation, so that it falls too slowly"
    aim = math.sqrt(low * high)
    lies_between = (first.variance > aim) != (second.variance > aim) and ratio > 0.0
    exponent = -math.log(more) / math.log(ratio) if lies_between else 1.0
    n_particles = _rounded(second.n_particles * (second.variance / aim) ** exponent)
    if n_particles == _LEAST:
        return n_particles, f"{found}; {_LEAST} are the fewest"
    return n_particles, f"{found}; it should be about {aim:.1f} with {n_particles}"


def _rounded(number: float) -> int:
    """Two digits of it, and at least ten."""
    return max(_LEAST, int(float(f"{number:.1e}")))


def _checked_target(target: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in target)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0.0 < low < high < np.inf:
        raise ModelError(f"target must be two positive numbers, the smaller first, got {target!r}")
    return low, high
