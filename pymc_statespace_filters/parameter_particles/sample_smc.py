"""`sample_smc`: a posterior by particles of the parameters, with its evidence."""

import os
from time import perf_counter
from typing import Any, Literal

import numpy as np
import pymc as pm
import xarray as xr

from ..compiler.native.compilation import COMPILATION
from ..errors import ModelError
from ..evidence.estimators.largest_likelihood import max_log_likelihood
from ..evidence.observed_data import observed_in
from ..evidence.posterior import Posterior
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..parallel.shared_rows import by_first_rank, outlasting_interrupts
from ..parallel.signals import keeps_what_is_there
from ..progress import stage_progress
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.inspection import given_model, is_filter
from ..pymc_model.other_filter import model_with
from ..pymc_model.prior import ModelFactors
from ..system.checks import check_flag, check_random_seed
from .filter_doubts import checked_at_end, not_checked
from .observed_rows import ObservedRows
from .output import DoubtsOf, as_datatree
from .particle_request import Request, Run, checked_request
from .sequential_output import finished
from .sequential_run import Progress
from .stored_run import progress_of_arrays
from .stored_steps import StoredSteps, steps_stored_in
from .whole_data import WholeLikelihood, missed_in, tempered_run

_MAXIMUM = 2**32 + 1  # key of random numbers beside those of the run


@keeps_what_is_there
@shared_by_ranks
def sample_smc(
    draws: int = 1000,
    *,
    model: pm.Model | None = None,
    data: Literal["tempered", "sequential"] = "tempered",
    populations: int = 10,
    inner: Filter | None = None,
    waste_free: bool = True,
    screen: Filter | None = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
    compute_convergence_checks: bool = True,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
) -> xr.DataTree:
    r"""Draw from a posterior by sequential Monte Carlo over its parameters, with the evidence.

    Several populations of weighted parameters, the particles, are led from the prior to the
    posterior; where few of them carry the weight, they are resampled and moved by Metropolis steps.

    Parameters
    ----------
    draws : int
        Particles in each population, at least twice as many as there are parameters.
    model : pymc.Model, optional
        With continuous free variables and a prior that can be drawn from; by default that of the
        ``with`` block.
    data : {"tempered", "sequential"}
        How the data come in. "tempered": all at once, the likelihood raised to powers that grow
        from 0 to 1; any model. "sequential": row by row, for a model whose data are one record of a
        `StateSpace` variable, with a filter whose state can go on: `EKF`, `UKF`, `IPLF`, `IMM`,
        `BootstrapPF`, `RBPF`, `EnKF` or `PFEnKF`. Each particle keeps its filter, so that a
        row costs one update of each; only moves filter the rows so far again. `extend` adds rows
        later.
    populations : int
        Populations, at least 2, whose spread gives the errors. One more, the pilot, chooses
        temperatures and steps, and is not part of the result.
    inner : filter, optional
        For the likelihood of every particle, in place of the filters of the model: as ``EnKF(200)``
        or ``BootstrapPF(100)`` for a model with `EKF`. The results of this run bring it along, so
        that `extend`, `reweight`, `estimate_evidence` and states take the same ``model``.
    waste_free : bool
        Whether all states of few long chains are the particles after a move (Dau and Chopin), or
        the last states of as many short chains as there are particles.
    screen : filter, optional
        A cheap filter without noise, such as `EKF`, for models with a particle or ensemble filter:
        moves that it finds unlikely are not evaluated by the other one. The posterior is the same;
        it pays if the screen's posterior is close.
    random_seed : int or numpy.random.Generator, optional
        Seed, of which the result is a function, on any number of threads and ranks.
    progressbar : bool
        Whether to show the stage, its effective size and acceptance, after two seconds.
    compute_convergence_checks : bool
        Whether to compare filters that are not exact with unbiased ones at the end, if there are
        600 particles or more; see `check_filter`. Also, with "tempered", whether to look for modes
        that the particles have missed, from points on their way, by at most 12 % more evaluations;
        a run that goes on from a checkpoint without these points does not look. Ctrl-C ends either
        without an outcome.
    checkpoint : str or path, optional
        A folder in which the particles are stored every few seconds, after a stage of "tempered" or
        a row of "sequential". If the process ends for any reason, the same call goes on from there,
        on any number of ranks, to the same result. It is refused for another model, other data or
        other arguments.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks that evaluate the particles together, as `sample_dram` takes them; the result does not
        depend on their number.

    Returns
    -------
    xarray.DataTree
        None on ranks that do not get it. After Ctrl-C in "sequential", without other ranks, that of
        the rows so far, which `extend` goes on from. The particles of "tempered" are draws of the
        posterior at the end alone: until then Ctrl-C raises, and only a checkpoint keeps the run.
        ``posterior`` and ``sample_stats`` (chain, draw), equally likely draws: particles of all
        populations, in proportion to weight and to the evidence that their population has found, in
        the order of their chains. A chain is nearly a population; ``sample_stats["population"]`` is
        the exact one, beside ``lp`` and, for a noisy variable "d", ``d_seed``. ``mcse`` has the
        Monte Carlo standard error of every posterior mean, from the spread of the populations:
        effective sample sizes of ArviZ do not hold for particles. ``smc`` has the course of the
        run: of "tempered" for each ``stage`` the ``temperature``, ``effective_size`` (population,
        stage), ``acceptance``, number ``n_steps`` and relative length ``scale`` of the moves, and
        the points ``n_evaluated``; of "sequential" for each ``row`` the ``score``,
        log p(d_j | d_1 .. d_{j-1}) with the parameters integrated out, ``score_se``,
        ``score_deviation`` (population, row), ``pit`` (row, observable), ``effective_size``, the
        particles ``n_alive`` of positive
        likelihood before moves (population, row), the number ``n_stages`` of moves, ``acceptance``,
        ``n_members`` of the filter, ``variance`` of the log-likelihood where it was measured, and
        the cost, ``n_updates`` of filters. ``evidence`` holds the evidence, as
        `estimate_evidence` stores it, with the estimator "smc"; the attributes ``log_evidence`` and
        ``log_evidence_se`` repeat it, and ``filter_check``, a JSON text, has the outcome of the
        comparison of filters; ``unvisited``, another one, is there if the run has looked for modes
        that the particles have missed, and lists a sentence about what it has found, or nothing.
        ``smc_state``, of "sequential", is what `extend` goes on from.

    Raises
    ------
    ModelError
        If an argument is invalid, a free variable is discrete, the prior cannot be drawn from, the
        likelihood is zero at nearly all its draws, or the data of "sequential" do not come row by
        row: several variables, a panel, a Potential, a `GuidedPF` or `GridFilter`.

    DataMismatchError
        If the checkpoint is of another run, or the ranks differ; the message says in what.
    ParallelError
        If another rank has failed, or MPI cannot be used.
    CheckpointError
        If a file of the checkpoint cannot be written or read.

    Warns
    -----
    EvidenceWarning
        If the evidences of the populations differ so much that a few decide, if a mode holds more
        of the posterior than of the particles, if moves are rarely accepted, or if a prior is not
        normalised.
    FilterWarning
        If a filter is found to be off; the evidence keeps this doubt.

    See Also
    --------
    extend : More rows for a sequential run.
    compare_evidence : Rival models, also row by row.
    sample : Chains, which take fewer evaluations for one posterior.
    estimate_evidence : The evidence from draws of any sampler.
    plot_prequential : Which rows speak for which model.

    Notes
    -----
    The product of the mean weights of a population is an unbiased estimate of the evidence, since
    the pilot alone decides when and how the others are moved. The evidences are averaged, and their
    standard error is wider by the ratio of Student's to the normal 95 % interval.

    A noisy likelihood is estimated when a point is proposed, and the estimate stays with its point:
    with an unbiased filter the posterior and the evidence are exact for any number of its members.
    `EnKF` and `PFEnKF` have a bias, which the results carry (``attrs["exact"]`` is 0), and which
    `reweight` corrects, if its weights are good. After moves
    of a sequential run the variance of the log-likelihood at fixed parameters is measured; above 2
    the members are doubled, the ratio of new to old estimates being a factor of the weights.
    ``attrs["filter"]`` is the filter at the end.

    The errors of scores of different rows are correlated. Their covariance is the sum of
    ``score_deviation`` of one row times that of the other over the populations, so that the squared
    error of a sum of scores is the sum over populations of the squared sum of deviations. ``pit``
    is the probability integral transform of an observable: the rank of the value in 1000 draws (or
    as many as there are particles) of its prediction from the rows before, parameters and filter
    included, randomised where values are equal. Transforms are uniform and independent from row to
    row if the data are from model and prior; NaN where nothing was observed.

    A sequential run with a noisy filter has no ``max_log_likelihood``, NaN.

    References
    ----------
    H.-D. Dau and N. Chopin (2022). Waste-free sequential Monte Carlo. J. R. Stat. Soc. B 84,
    114-148. N. Chopin (2002). A sequential particle filter method for static models. Biometrika 89,
    539-551. N. Chopin, P. E. Jacob and O. Papaspiliopoulos (2013). SMC^2. J. R. Stat. Soc. B 75,
    397-426.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     idata = psf.sample_smc(200, random_seed=2, progressbar=False)
    >>> exact, found, error = -4.6154, idata.attrs["log_evidence"], idata.attrs["log_evidence_se"]
    >>> abs(found - exact) < 4 * error < 0.4
    True
    """
    model = given_model(model)
    if inner is not None:
        model = model_with(model, "inner", inner)
    _check_screen(screen)
    if not (isinstance(data, str) and data in ("tempered", "sequential")):
        raise ModelError(f"data must be 'tempered' or 'sequential', got {data!r}")
    rng = check_random_seed(random_seed)
    entropy = by_first_rank(lambda: tuple(rng.integers(2**63, size=2).tolist()))
    request = checked_request(model, draws, populations, waste_free, entropy)
    inside, outside = ("" if one is None else short_form(one) for one in (inner, screen))
    request = request._replace(inner=inside, screen=outside)
    check_flag("progressbar", progressbar)
    checks = check_flag("compute_convergence_checks", compute_convergence_checks)
    is_seeded = random_seed is not None
    with (
        COMPILATION,
        steps_stored_in(
            checkpoint, lambda: request.settings(model, data, is_seeded=is_seeded)
        ) as steps,
    ):
        own = request.going_on(steps.found)
        doubts_of: DoubtsOf = not_checked
        if checks:
            doubts_of = checked_at_end(model, own, progressbar=progressbar)
        if data == "sequential":
            return _sequential(model, own, screen, doubts_of, steps, progressbar)
        return _tempered(model, own, screen, doubts_of, steps, progressbar, looks=checks)


def _check_screen(screen: Any) -> None:
    if screen is not None and (not is_filter(screen) or screen.noisy):
        raise ModelError(
            f"screen must be None or a filter without noise, such as psf.EKF(), got {screen!r}"
        )


def _tempered(
    model: pm.Model,
    request: Request,
    screen: Filter | None,
    doubts_of: DoubtsOf,
    steps: StoredSteps,
    progressbar: bool,
    *,
    looks: bool,
) -> xr.DataTree:
    began, likelihood = perf_counter(), WholeLikelihood(model, screen)
    with stage_progress(1.0, enabled=progressbar) as show:
        run, visited = tempered_run(model, likelihood, request, show, steps, looks=looks)
        maximum = outlasting_interrupts(lambda: _maximum(likelihood.factors, run, request), np.nan)
        missed = outlasting_interrupts(
            lambda: missed_in(run, visited, model, likelihood, request), None
        )
    seconds, run = perf_counter() - began, run._replace(missed=missed)
    observed = observed_in(model)
    return as_datatree(
        model, run, request, observed, data="tempered", seconds=seconds, maximum=maximum,
        doubts_of=doubts_of,
    )  # fmt: skip


def _sequential(
    model: pm.Model,
    request: Request,
    screen: Filter | None,
    doubts_of: DoubtsOf,
    steps: StoredSteps,
    progressbar: bool,
) -> xr.DataTree:
    rows = ObservedRows.of(model, screen)
    if steps.found:
        begin = progress_of_arrays(steps.found, rows)
    else:
        begin = Progress.before_any_row(rows, request)
    return finished(begin, request, doubts_of, steps, progressbar=progressbar)


def _maximum(factors: ModelFactors, run: Run, request: Request) -> float:
    """The largest log-likelihood found by a search from the particles."""
    particles, shape = run.cloud.others.particles, run.cloud.others.log_weights.shape

    def evaluate(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.add(*factors.evaluate(x, rng))

    posterior = Posterior(
        particles.x.reshape(*shape, -1),
        particles.log_density(1.0).reshape(shape),
        evaluate,
        factors.is_noisy,
        factors.prior,
    )
    return max_log_likelihood(posterior, request.generator(_MAXIMUM)).log_likelihood
