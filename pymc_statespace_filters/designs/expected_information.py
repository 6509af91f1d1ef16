"""The public function: what a record of each design is expected to say, before it is measured."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError, ModelWarning, warn
from ..evidence.comparison.selection import prior_weights
from ..parallel.cpu_affinity import cores_set_to
from ..progress import stage_progress
from ..pymc_model.in_step import shared_by_ranks
from ..system.checks import check_count, check_flag, check_positive, check_random_seed
from .candidates import read_designs
from .designs_table import DesignsTable, table_of
from .information import Records, replicates
from .rivals import FEWEST, named_models, read_rivals
from .simulated_records import SimulatedRecords

_MOST_GROUPS = 40  # of draws, each of which the jackknife leaves out once
_MOST = 10**6  # draws, or records, which memory holds
_MOST_TIMES = 16  # the number of records, for a target

Array = NDArray[np.float64]


@shared_by_ranks
def expected_information(
    models: pm.Model | Mapping[str, pm.Model],
    designs: Mapping[str, Mapping[str, Any]],
    *,
    idata: xr.DataTree | Mapping[str, xr.DataTree] | None = None,
    n_records: int = 200,
    n_draws: int = 1000,
    model_prior: Mapping[str, float] | None = None,
    odds: float = 20,
    var_names: Sequence[str] | None = None,
    target_se: float | None = None,
    cores: int | None = None,
    comm: Any = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> DesignsTable:
    r"""Compare experiments by what a record of each is expected to say, before it is measured.

    Records of each design are simulated by every model, at draws of its parameters, and their
    likelihoods are computed at the draws of all models. Draws of the prior ask what an experiment
    says to one who has no data; those of a posterior ask what one more record would add.

    Parameters
    ----------
    models : pymc.Model or mapping of str to pymc.Model
        One model, or rivals by name, each with one `StateSpace` variable of one record, with data
        or without, and a filter whose likelihood is the same at each call.
    designs : mapping of str to mapping
        Designs by name: arguments of `StateSpace` that say when and what is measured (``steps`` or
        ``times``, ``inputs``, ``input_times``, ``inputs_at``, ``t0``, ``unit``, ``events``), and
        ``sensors``, a list of observables, by default all. All models take the same arguments. Give
        ``times`` where their steps differ.
    idata : xarray.DataTree or mapping of str to xarray.DataTree, optional
        Posterior draws of the model, or of each, by its filter or another one; by default draws of
        the priors. The new record starts afresh, from the initial state of the system.
    n_records : int
        Number of records that each model simulates of each design, at least 20.
    n_draws : int
        Number of draws of each model, at least 20. Of ``idata`` no more are used than their
        effective number, the smallest bulk effective sample size.
    model_prior : mapping of str to float, optional
        Positive weight of every model before the new record, normalised here; equal by default.
    odds : float
        At which odds, at least 1, a model counts as decided for.
    var_names : sequence of str, optional
        Free variables of every model, independent of the others in its prior: the information about
        parameters is about these alone, and the others, such as the level of the noise, are unknown
        before the record and after it. Twice as many likelihoods are computed for one model. With
        ``idata``, whose draws are dependent, it must be None.
    target_se : float, optional
        The number of records is doubled, up to 16 times ``n_records``, until ``se`` is not larger
        in any design.
    cores : int, optional
        Number of threads; by default all cores. The result is the same, bit for bit.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks that share the records, as `sample_dram` takes them; the result is the same.
    random_seed : int or numpy.random.Generator, optional
        Record r of a model has the same noise in all designs.
    progressbar : bool
        Whether to show progress.

    Returns
    -------
    pandas.DataFrame
        Index ``design``, best first. Its display shows the first columns that are marked by an
        asterisk, and sentences: what the order is by, which designs are not told apart, where the
        draws are too few, how many draws were used, and which likelihoods are approximate. All
        information is in nats. ``table.to_string()`` shows all columns:

        ``information`` \*, ``low`` \*, ``high`` \*, ``se`` \*, ``change``, ``low_se``, ``high_se``
            Of several models: expected information about which one is true. ``low``, from evidences
            without the draw that made the record, is a lower bound; in ``high`` that draw is in the
            evidence of the true model. Of one model: expected information about its parameters,
            ``low`` by the contrastive estimate, a lower bound, and ``high`` by the nested one, an
            upper bound. ``information`` is the middle, ``se`` its standard error, and ``change``
            how far it has moved from what half of the draws give.
        ``diff`` \*, ``dse`` \*
            Difference from the first row, and its standard error, to which noise that designs have
            in common does not contribute.
        ``decided`` \*, ``misled`` \*
            Of several models: the probability that the posterior odds of the true model against all
            others together will be above `odds`, and that those of a wrong one will be.
            ``decided[a]``, ``misled[a]``: the same if model a is true.
        ``parameters[a]``, ``parameters_low[a]``, ``parameters_high[a]``
            Of several models: expected information about the parameters of model a, if it is true.
        ``log_bf[a, b]``
            Expected log Bayes factor of a against b, if a is true.
        ``n_records[a]``, ``n_draws[a]``, ``n_effective[a]``
            Records that count, draws that are used, and the effective number of all draws.

        Columns with ``_se`` and ``_change`` before the bracket belong to these.

    Raises
    ------
    ModelError
        If an argument is invalid, a model cannot take a design, or a filter is noisy.
    DataMismatchError
        If draws are those of another model.

    Warns
    -----
    ModelWarning
        If simulated records, or their likelihoods at the parameters that made them, are not finite:
        they are left out.

    Notes
    -----
    With draws :math:`\theta_j` of the prior and a record y made by :math:`\theta_0`, the nested
    estimate is the mean of :math:`\log p(y|\theta_0) - \log \frac1n \sum_{j \geq 1} p(y|\theta_j)`,
    and the contrastive one has j = 0 in the sum, too, so that it cannot exceed log(n + 1). See
    Foster et al. (2020), A unified stochastic gradient approach to designing Bayesian-optimal
    experiments, AISTATS. Standard errors are those of a jackknife that leaves out groups of draws
    together with the records that they made: they cover records, draws, and their covariance.

    The likelihood is that of the filter; where it is an approximation, so is the information.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, u, a: [a * x[0] + u[0] + q[0]],
    ...     process_noise=[[0.1]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[0.1]],
    ...     inputs=["force"],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace("d", system, psf.EKF(), steps=[0, 1], inputs=[0.0])
    >>> steps = [0, 1, 2, 3, 4]
    >>> designs = {
    ...     "at rest": {"steps": steps, "inputs": [0.0, 0.0, 0.0, 0.0]},
    ...     "pushed": {"steps": steps, "inputs": [1.0, 1.0, 1.0, 1.0]},
    ... }
    >>> table = psf.expected_information(model, designs, random_seed=1, progressbar=False)
    >>> list(table.index)
    ['pushed', 'at rest']
    """
    named = named_models(models)
    n_wanted = check_count("n_records", n_records, FEWEST, _MOST)
    check_count("n_draws", n_draws, FEWEST, _MOST)
    if check_positive("odds", odds) < 1:
        raise ModelError(f"odds must be at least 1, got {odds!r}")
    target = None if target_se is None else check_positive("target_se", target_se)
    threads = None if cores is None else check_count("cores", cores, 1)
    is_shown = check_flag("progressbar", progressbar)
    rng = check_random_seed(random_seed)
    weights = prior_weights(model_prior, list(named))
    seed = int(rng.integers(2**63))
    rivals = read_rivals(named, idata, n_draws, rng, var_names)
    candidates = read_designs(designs, rivals)
    numbers = np.array([len(rival.theta) for rival in rivals.values()])
    n_groups = int(min(_MOST_GROUPS, n_wanted, numbers.min()))
    simulated = SimulatedRecords(list(candidates.values()), list(rivals.values()), n_groups, seed)
    with cores_set_to(threads):
        own, sums = _rows(simulated, range(n_wanted), is_shown)
        while True:
            found = {
                name: replicates(Records(own[d], sums[d], numbers), weights, odds)
                for d, name in enumerate(candidates)
            }
            n_kept = _kept(own, list(candidates), list(rivals))
            table = table_of(found, n_kept, rivals, weights, var_names)
            n = own.shape[-1]
            if target is None or (table["se"] <= target).all() or n >= _MOST_TIMES * n_wanted:
                break
            further = _rows(simulated, range(n, 2 * n), is_shown)
            own, sums = (
                np.concatenate(parts, axis=2) for parts in zip((own, sums), further, strict=True)
            )
    _warn_of_left_out(n_kept, n, list(rivals))
    return table


def _rows(simulated: SimulatedRecords, numbers: range, is_shown: bool) -> tuple[Array, Array]:
    """The records of these numbers, with a bar."""
    n_done = 0
    with stage_progress(float(simulated.n_rows(numbers)), enabled=is_shown) as show:

        def on_progress(count: int) -> None:
            nonlocal n_done
            n_done += count
            show(n_done, "Records and their likelihoods")

        return simulated(numbers, on_progress)


def _kept(own: Array, designs: list[str], models: list[str]) -> dict[str, list[int]]:
    """The number of records of each model under each design that are finite; enough of them."""
    counts = (~np.isnan(own)).sum(axis=2)
    for d, m in np.argwhere(counts < FEWEST).tolist():
        raise ModelError(
            f"designs[{designs[d]!r}] must have at least {FEWEST} finite records, got "
            f"{counts[d, m]} of {own.shape[2]} of the model {models[m]!r}: at most draws of its "
            "parameters its states overflow, or its filter fails: narrow the priors"
        )
    return dict(zip(designs, counts.tolist(), strict=True))


def _warn_of_left_out(n_kept: Mapping[str, list[int]], n: int, models: list[str]) -> None:
    """Warn of the design with the fewest records."""
    least, design, model = min(
        (count, name, models[m])
        for name, counts in n_kept.items()
        for m, count in enumerate(counts)
    )
    if least < n:
        warn(
            f"{n - least} of {n} records of the model {model!r} with the design {design!r} are "
            "left out, because they, or their likelihoods at the parameters that made them, are "
            "not finite: the numbers are about the others; narrow the priors",
            ModelWarning,
        )
