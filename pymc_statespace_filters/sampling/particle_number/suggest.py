"""``suggest_particles``: the number of particles for a noisy likelihood, measured on the model."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pymc.model import Model

from ...errors import FilterWarning, ModelError
from ...progress import row_progress
from ...system.checks import check_positive, check_random_seed
from ..output.likelihood_variance import TARGET, acceptance_share
from .effort import Effort, OutOfTimeError
from .measurement import Measurement
from .noisy_likelihood import NoisyLikelihood
from .search import Row, best_guess, choose, nearest_row, search


class _Suggestion(NamedTuple):
    """The number, its row unless it was not measured, the row it follows from, and the problem."""

    n_particles: int
    row: Row | None
    basis: Row
    problem: str | None


def suggest_particles(
    model: Model,
    *,
    var_name: str | None = None,
    target: tuple[float, float] = TARGET,
    random_seed: int | np.random.Generator | None = None,
    max_seconds: float = 180.0,
    progressbar: bool = True,
) -> pd.DataFrame:
    """Find the number of particles at which a chain gains most per unit of time.

    A short chain with fixed noise finds where the posterior lies. At its centre, and at five points
    of its tail, the likelihood is then estimated with many noise seeds, for larger and smaller
    numbers of particles than the model's own, until the variances of the log-likelihood at the
    centre bracket the target.

    Parameters
    ----------
    model : pymc.Model
        With a StateSpace variable whose filter is noisy, and continuous free variables.
    var_name : str, optional
        Name of the variable, required if several are noisy. The others keep their filters and
        their noise, which adds to the variance of the log-likelihood in a chain.
    target : (float, float), default (1.0, 3.3)
        Range for the variance of the estimated log-likelihood. Per unit of time chains gain most
        between 1 and 3.3 [1]_, [2]_. In a panel whose records share no parameter, `sample_dram`
        accepts each record by its own likelihood, and the range is that of the record with the
        largest variance. With shared parameters it is that of the sum.
    random_seed : None, int or numpy.random.Generator
        It determines the table except the column ``seconds``, unless ``max_seconds`` is reached.
    max_seconds : float, default 180
        Time after which the search ends with what it has measured. Compilation does not count, and
        the first 25 estimates are always made.
    progressbar : bool
        Whether to show what is being measured, and how far it is.

    Returns
    -------
    pandas.DataFrame
        A row for each number measured, indexed by ``n_particles``; the suggested number is in
        ``attrs["n_particles"]``, and ``attrs["extrapolated"]`` says whether it was not measured but
        computed from another, because time was up. ``attrs["noisiest"]`` are the rows of the
        record, from 0, that carry most of the variance, with their shares: the fewest that carry
        half of it, at most five. The columns are

        ``variance_centre``, ``variance_low``, ``variance_high``
            variance of the estimated log-likelihood at the centre, and a 95 % interval for it
        ``variance_tail``
            largest of the tail points' variances, each from 30 seeds; NaN if the variance at the
            centre is so far from the target that the tail was not measured
        ``n_failed``
            evaluations that failed, which are not in the variances
        ``acceptance``
            lower bound for the fraction of an exact likelihood's accepted moves that a chain
            accepts with the noise at the centre: 2 Phi(-sqrt(variance / 2)), for Gaussian errors
        ``seconds``
            CPU time of one evaluation of the model
        ``suggested``
            whether this number is suggested

    Raises
    ------
    ModelError
        If an argument is not as described, the model has no noisy variable, or has several and
        ``var_name`` is not given, or a free variable is discrete.

    Warns
    -----
    FilterWarning
        If no number tried brings the variance into the target range, or if it is above 10 in the
        tail; if time is up, or the user interrupts (Ctrl-C) when a number has been measured; if
        1000 particles or more are needed for a fiftieth of the observations. It names the
        observations that carry the variance, and a filter with less noise if the system allows one.
        If the estimates are off whatever their variance, as `check_filter` finds.

    Notes
    -----
    The centre is the best of the pilot's five highest draws, by 12 new estimates each; the tail
    points are the draws with density no lower than 1, 2, .., 5 % of all draws. The suggestion is
    the smallest number, of two digits, whose variance is within the target at the centre, with a
    margin for the error of measurement, and below 10 at the tail points; it is 10 if the variance
    is below the target even with 10 particles.

    The cost is 1000 to 1300 evaluations for the pilot, with 200 to 1000 particles, in two threads,
    and 250 for each of at most seven numbers, in as many threads as there are cores. If the pilot's
    own variance turns out to be above 10 it is repeated: with `GridFilter` or `GuidedPF` if the
    model's filter is unbiased and the system allows one of them, which has the same posterior, else
    with up to sixteen times as many particles. A pilot is cut when a quarter of ``max_seconds`` has
    passed, a repeated one after half. Numbers above 64 times the model's own, and above 16 000, are
    not tried.

    The number of particles changes the variance, and for EnKF and PFEnKF also the bias, which a
    small variance does not exclude: the suggested number is compared with exact or unbiased filters
    at draws of the pilot, in two seconds.

    References
    ----------
    .. [1] A. Doucet, M. K. Pitt, G. Deligiannidis and R. Kohn (2015). Efficient implementation of
       Markov chain Monte Carlo when using an unbiased likelihood estimator. Biometrika 102,
       295-313.
    .. [2] C. Sherlock, A. H. Thiery, G. O. Roberts and J. S. Rosenthal (2015). On the efficiency of
       pseudo-marginal random walk Metropolis algorithms. Annals of Statistics 43, 238-275.

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
    >>> bool(1.0 < table.loc[table.attrs["n_particles"], "variance_centre"] < 3.3)
    True
    """
    target = _checked_target(target)
    effort = Effort(check_positive("max_seconds", max_seconds))
    likelihood = NoisyLikelihood(model, var_name, check_random_seed(random_seed), effort)
    measurement = Measurement(likelihood, effort, target)
    doubt = None
    with row_progress(effort, enabled=progressbar, patience=0.0) as announce:
        effort.announce = announce
        try:
            measurement.find_points()
            rows = search(measurement.measure, likelihood.filter.size(), target)
            row, problem = choose(rows, target)
            found = _Suggestion(row.n_particles, row, row, problem)
            doubt = likelihood.doubt(row.n_particles)
        except (OutOfTimeError, KeyboardInterrupt) as reason:
            rows = sorted(measurement.rows.values())
            if not rows:
                raise
            is_late = isinstance(reason, OutOfTimeError)
            stopped = f"stopped after max_seconds={max_seconds:g}" if is_late else "interrupted"
            found = _unfinished(rows, target, stopped)
        if found.problem is None and not likelihood.pilot_is_complete:
            cut = "the pilot was cut to keep max_seconds, so that the centre may be off"
            found = found._replace(problem=cut)
        advice = measurement.advice(found.basis, found.n_particles, found.problem)
    said = [text for text in (found.problem, *advice, doubt) if text]
    if text := ". ".join(said):
        warnings.warn(f"{likelihood.name}: {text}", FilterWarning, stacklevel=2)
    return _table(rows, found, measurement.noisiest_at(found.basis))


def _unfinished(rows: Sequence[Row], target: tuple[float, float], stopped: str) -> _Suggestion:
    """What is known after an unfinished search."""
    n, row = best_guess(rows, target)
    basis = nearest_row(rows, target[1]) if row is None else row
    measured = "one number" if len(rows) == 1 else f"{len(rows)} numbers"
    if row is None:
        how = (
            f"{n} particles are extrapolated from the variance of {basis.centre.variance:.3g} "
            f"with {basis.n_particles}, as about proportional to 1/N"
        )
    else:
        how = f"{n} particles are the best of them, with a variance of {row.centre.variance:.3g}"
    return _Suggestion(n, row, basis, f"{stopped}, with {measured} of particles measured: {how}")


def _table(rows: Sequence[Row], found: _Suggestion, noisiest: Mapping[int, float]) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "n_particles": [row.n_particles for row in rows],
            "variance_centre": [row.centre.variance for row in rows],
            "variance_low": [row.centre.variance_low for row in rows],
            "variance_high": [row.centre.variance_high for row in rows],
            "variance_tail": [row.tail for row in rows],
            "n_failed": [row.n_failed for row in rows],
            "acceptance": [acceptance_share(row.centre.variance) for row in rows],
            "seconds": [row.seconds for row in rows],
            "suggested": [row is found.row for row in rows],
        }
    ).set_index("n_particles")
    table.attrs |= {
        "n_particles": found.n_particles,
        "extrapolated": found.row is None,
        "noisiest": dict(noisiest),
    }
    return table


def _checked_target(target: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in target)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0.0 < low < high < np.inf:
        raise ModelError(f"target must be two positive numbers, the smaller first, got {target!r}")
    return low, high
