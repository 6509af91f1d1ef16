"""Log-likelihoods without PyMC: numbers in, numbers out."""

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ..compiler.numerics.philox import seeds_of_records
from ..errors import DataMismatchError, ModelError
from ..filters.checks import check_choice
from ..filters.outcomes import COLLAPSED, NONE
from ..filters.protocol import DifferentiableFilter, Filter
from ..ops.base import HEALTH_SIZE, evaluator
from ..ops.distributed import check_ranks, distributed_evaluator
from ..ops.likelihood import LogLikelihood
from ..ops.signatures import PANEL, POINTS
from ..parallel.communicator import Communicator, communicator_of
from ..system.checks import check_count
from ..system.given_record import GivenRecord
from ..system.model import StateSpaceModel
from ..system.parameters import flat_parameters, panel_parameters
from ..system.record import Record, check_seed, read_record
from .exact_rows import check_rows
from .health import Health


def log_likelihood(
    system: StateSpaceModel,
    filter: Filter,
    params: Any,
    observed: Any,
    *,
    steps: Any = None,
    times: Any = None,
    panel: Any = None,
    inputs: Any = None,
    t0: Any = 0.0,
    unit: Any = None,
    input_times: Any = None,
    inputs_at: str = "hold",
    events: Any = None,
    censored: Any = None,
    seed: Any = 0,
    comm: Any = None,
    cores: int = 1,
) -> np.ndarray:
    """Evaluate the log-likelihood of a record, or of the records of a panel, term by term.

    Parameters
    ----------
    system : StateSpaceModel
    filter : a filter of the package, such as EKF, GuidedPF, IMM or FiniteStateFilter
    params : mapping
        Parameter values by name; arrays broadcast to a shape S (a declared parameter's own shape
        comes last).
    observed : array_like, shape (J, p), or (J,) if p = 1
        The record; NaN marks a missing component.
    steps : array_like of int, shape (J,)
        The step of each observation; 0 is where the initial state holds. Or give `times`.
    times : array_like, shape (J,)
        Times of the observations, numbers or dates, see `StateSpace`.
    panel : array_like of int or str, shape (J,), optional
        For many records: the label of the record of each row, see `StateSpace`. Parameters are
        then numbers for all G records, or have a leading dimension G; ``seed`` is one number.
    inputs : array_like, shape (rows, n_inputs)
        Row k holds during step k; in a panel, one such array for all records or one for each.
    t0, unit, input_times, inputs_at, events, censored
        See `StateSpace`.
    seed : int or array_like of int
        Seed of the noise inside the filter, if it has any; broadcasts with the parameters.
    comm : mpi4py.MPI.Intracomm or "world", optional
        Ranks among which the filter's members are divided, in blocks of 64. All of them make
        this call with the same arguments and get the same result, bit for bit that of one rank.
    cores : int
        Threads among which the records of a panel are divided; the result is the same, bit for bit.

    Returns
    -------
    ndarray, shape S + (J,)
        log p(d_j | d_1 .. d_{j-1}); their sum over j is the log-likelihood. A wholly missing row
        has the term 0; from an observation at which the filter fails on, terms are -inf.

    Raises
    ------
    ModelError
        If an argument does not fit the system, or the filter has not enough members for the ranks.
    ParallelError
        If MPI cannot be used as requested, or the ranks differ.

    Warns
    -----
    FilterWarning
        On the first rank, once for each reason why the filter failed, and if its particles
        collapsed; and if it linearises an equation that jumps as the state moves, or has members
        that are all the same.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> terms = psf.log_likelihood(system, psf.EKF(), {"a": 0.9}, [0.3, 1.2], steps=[0, 3])
    >>> terms.shape
    (2,)
    """
    check_choice(system, filter)
    given = GivenRecord(
        observed, panel, steps, times, inputs, t0, unit, input_times, inputs_at, events, censored
    )
    n_threads, seeds = check_count("cores", cores, 1), check_seed("seed", seed)
    record = read_record(system, given)
    check_rows(record, filter)
    if record.is_panel and comm is not None:
        raise ModelError("comm must be None for a panel: every rank evaluates all records")
    if n_threads > 1 and not record.is_panel:
        raise ModelError(f"cores must be 1 without a panel, whose records it divides, got {cores}")
    with communicator_of(comm) as ranks:
        if record.is_panel:
            theta = panel_parameters(record.system, params, record.records)
            found = _of_panel(record, filter, theta, seeds, n_threads)
        else:
            found = _at_points(record, filter, flat_parameters(record.system, params), seeds, ranks)
        if ranks.rank == 0:
            Health(record.system, filter, found.health, found.arguments_of, record.labels).tell()
    return found.terms


class _Found(NamedTuple):
    """Terms, health (n, 3) of all evaluations, and the arguments of each, see `Health`."""

    terms: np.ndarray
    health: np.ndarray
    arguments_of: Callable[[int], tuple]


def _of_panel(
    record: Record, filter: Filter, theta: np.ndarray, seed: np.ndarray, n_threads: int
) -> _Found:
    """All records, which threads share; if some fail, each is repeated to say which."""
    if seed.ndim:
        raise ModelError(f"seed must be one number for a panel, got shape {seed.shape}")
    system, records = record.system, record.records
    evaluate = evaluator(LogLikelihood(system, filter, PANEL))

    def part(first: int, last: int) -> tuple:
        rows = slice(records.starts[first], records.starts[last])
        data = record.steps[rows], record.observed[rows], record.inputs, record.t0
        return evaluate(theta[first:last], *data, seed)

    n_parts = min(n_threads, len(theta))
    ends = np.linspace(0, len(theta), n_parts + 1).astype(int)
    if n_parts > 1:
        part(0, 0)  # compiles, before there are threads
    with ThreadPoolExecutor(n_parts) as pool:
        terms, health = zip(*pool.map(part, ends[:-1], ends[1:]), strict=True)
    seeds = seeds_of_records(seed, records.codes)
    each = zip(theta, record.each(), seeds, strict=True)
    arguments = [(own, *rows, own_seed) for own, rows, own_seed in each]
    if any(one[1] != NONE or one[0] < COLLAPSED for one in health):
        evaluate_alone = evaluator(LogLikelihood(system, filter))
        health = tuple(evaluate_alone(*one)[1] for one in arguments)
    return _Found(np.concatenate(terms), np.array(health), lambda g: arguments[g])


def _at_points(
    record: Record, filter: Filter, theta: np.ndarray, seeds: np.ndarray, ranks: Communicator
) -> _Found:
    """A record at all points, side by side if the filter can, else one by one."""
    system, arguments = record.system, record.arguments
    try:
        shape = np.broadcast_shapes(theta.shape[:-1], seeds.shape)
    except ValueError:
        raise ModelError(
            f"seed of shape {seeds.shape} does not broadcast with parameters "
            f"of shape {theta.shape[:-1]}"
        ) from None
    seeds = np.broadcast_to(seeds, shape).ravel()
    points = np.ascontiguousarray(np.broadcast_to(theta, (*shape, theta.shape[-1])))
    points = points.reshape(seeds.size, theta.shape[-1])
    check_ranks(filter, ranks.size)
    if ranks.size > 1:
        _check_agreement(ranks, filter, (points, *arguments, seeds))
    if len(points) > 1 and isinstance(filter, DifferentiableFilter):
        # A filter with a gradient is deterministic: any seed will do.
        evaluate = evaluator(LogLikelihood(system, filter, POINTS))
        terms, health = evaluate(points, *arguments, seeds[0])
    else:
        evaluate = distributed_evaluator(system, filter, ranks)
        terms = np.empty((len(points), record.steps.size))
        health = np.empty((len(points), HEALTH_SIZE))
        for i, point in enumerate(points):
            terms[i], health[i] = evaluate(point, *arguments, np.asarray(seeds[i]))
    return _Found(
        terms.reshape(*shape, record.steps.size),
        health,
        lambda i: (points[i], *arguments, seeds[i]),
    )


def _check_agreement(ranks: Communicator, filter: Filter, arrays: Sequence[np.ndarray]) -> None:
    """Raise, on all ranks, unless all make the same call."""
    mine = hashlib.sha256(repr((filter, [array.shape for array in arrays])).encode())
    for array in arrays:
        mine.update(np.ascontiguousarray(array).tobytes())
    digests = ranks.allgather(mine.digest())
    for rank, theirs in enumerate(digests):
        if theirs != digests[0]:
            raise DataMismatchError(
                f"all ranks must make the same call, got other parameters, seeds, data or another "
                f"filter on rank {rank} of {ranks.size} than on rank 0"
            )
