"""`check_filter`: whether the filter of a model is right, by unbiased estimates at draws."""

from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr

from ..checks.filters.budget import Budget
from ..checks.filters.checks import check_model, outcomes_of, store
from ..filters.protocol import check_filter as check_is_filter
from ..pymc_model.checked_model import checked_model
from ..system.checks import check_count, check_flag, check_random_seed
from ..tables import SentenceTable

_LEAST_POINTS = 8
_SECONDS = 20.0  # of CPU time, for all variables


class FilterCheckTable(SentenceTable):
    """The checks of the filters of a model; the sentences are the verdicts."""

    main_columns = ("variable", "check", "statistic", "se", "visible", "outcome")

    def _texts(self, name: str) -> list[str]:
        is_number = name in ("statistic", "se", "visible")
        return [f"{value:.2f}" if is_number else str(value) for value in self[name]]


def check_filter(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    filter: Any = None,
    n_draws: int = 20,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> FilterCheckTable:
    """Compare a filter's log-likelihood with that of the system, at draws of the posterior.

    The likelihood of an EKF, UKF, IPLF, EnKF or PFEnKF is an approximation unless the system is
    linear, and none of them tells how good it is. That of a `GuidedPF` is right in the mean over
    seeds, but where several explanations fit the data equally well its particles may follow one of
    them: nearly all estimates are then too low, by an amount that their spread over seeds does not
    show. Both show in a comparison with filters that are exact or unbiased: `GridFilter` for one
    state, else `GuidedPF` or, where that scatters, `BootstrapPF` with as many particles as some
    twenty seconds allow. The first that decides is enough.

    Half of the points are draws, from any sampler; more are compared where these do not show how
    far parameters would move. The others lie around them, twice or three times as far from their
    mean, or are draws of the prior: a chain stays away from where its filter is too low, so that
    draws cannot show it. Of these points those count at which the posterior would be as high as at
    the draws.

    All samplers of this package make the same check at the end of a run, with a second or a tenth
    of the run's time, in which another filter must be compiled. Some loops of a filter are compiled
    once per installation, in 5 to 20 seconds: a check at the end of a short run leaves that to this
    function.

    Parameters
    ----------
    idata : xarray.DataTree
        Draws of the posterior, at least twenty of each chain. Without ``filter`` the outcomes are
        stored in its attribute ``filter_check``, from where `estimate_evidence` and
        `filter_diagnostics` repeat them.
    model : pymc.Model, optional
        Default: the model of the ``with`` block. Its free variables must be continuous.
    filter : filter, optional
        Checked in place of the model's own, at the same points.
    n_draws : int
        Number of points to begin with, at least 8.
    random_seed : None, int or numpy.random.Generator
        Seed of the points and of the noise. The numbers follow from it, unless time was up or an
        evaluation by an exact filter takes about the fiftieth of a second up to which it is used.
    progressbar : bool
        Whether to show the points that are done, if they take more than two seconds.

    Returns
    -------
    pandas.DataFrame
        A row for each check of each observed StateSpace variable. Its display shows the numbers
        and outcomes, and below them the verdicts. The columns are

        ``variable``, ``filter``
            the variable, and the filter that was checked
        ``check``
            "bias": the log-likelihood at draws against that of the system; "shift of NAME": where
            the element NAME of the unconstrained parameters would lie without the difference, to
            first order; "bias elsewhere": how much lower the filter is at the other points than at
            draws; "low at draws", "low elsewhere": whether an unbiased filter is too low; "exact"
            where there is nothing to check
        ``statistic``, ``se``
            nats, filter minus reference in the mean of the points, or posterior standard
            deviations, and the standard error; of "bias elsewhere" the nats that are proved
        ``alpha``
            the probability at most with which a filter that is right is called "off"
        ``visible``
            a difference that would have been seen
        ``outcome``
            "exact", "no sign", "off" or "undecided"
        ``verdict``
            the same in words, with a filter that works where this one is off

    Raises
    ------
    ModelError
        If the model has no observed StateSpace variable or a discrete free variable, the filter
        cannot treat its system, or an argument is not as described.
    DataMismatchError
        If idata lacks draws of a free variable, or they are those of another model or other data.

    Notes
    -----
    The mean difference at draws moves the log-evidence. To first order the posterior of a parameter
    moves by its covariance with the difference, over its standard deviation, which is at most the
    standard deviation of the difference. What the noise of the reference adds to the spread of the
    difference is taken out of it.

    That a filter is too low is proved without knowing the law of the estimates: if the likelihood
    is at most a bound, the mean of unbiased estimates over that bound is at most 1, and a gambler
    who bets on more wins a factor of 1 / alpha with probability alpha at most [1]_.

    A filter is "off" if it is off by more than a nat at draws, if the difference varies by more
    than three nats between draws, if a parameter is moved by more than half a standard deviation,
    or if the filter is lower elsewhere by three nats more than is usual between draws. An unbiased
    one is "off" if it is proved to be a nat too low. A filter passes if a difference of three nats
    would have been seen. Guided particles linearise as the filter does, but scatter over seeds
    where that misleads them: they are trusted if they scatter by half a nat or less, plain ones up
    to two nats. Otherwise the check is undecided, unless either prove the filter too low. A guided
    filter itself is judged by plain ones. A model with ``score_from`` is compared on the rows that
    are scored.

    References
    ----------
    .. [1] A. Ramdas, P. Gruenwald, V. Vovk and G. Shafer (2023). Game-theoretic statistics and safe
       anytime-valid inference. Statistical Science 38, 576-601.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0] ** 2],
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
    ...     idata = psf.sample_dram(
    ...         300, tune=300, chains=2, random_seed=1, progressbar=False,
    ...         compute_convergence_checks=False,
    ...     )
    >>> table = psf.check_filter(idata, model, random_seed=2)
    >>> table["outcome"][0]
    'off'
    >>> "GridFilter" in table["verdict"][0]
    True
    """
    model = checked_model(model, idata, any_filter=filter is not None)
    if filter is not None:
        check_is_filter(filter)
    table = check_model(
        idata,
        model,
        filter=filter,
        n_points=check_count("n_draws", n_draws, _LEAST_POINTS),
        budget=Budget(_SECONDS),
        rng=check_random_seed(random_seed),
        progressbar=check_flag("progressbar", progressbar),
    )
    if filter is None:
        store(idata, outcomes_of(table))
    return FilterCheckTable(table, sentences=_verdicts(table))


def _verdicts(table: pd.DataFrame) -> list[str]:
    pairs = zip(table["check"], table["verdict"], strict=True)
    return [f"{check}: {verdict.rstrip('.')}." for check, verdict in pairs]
