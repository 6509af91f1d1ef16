"""The statistics of each draw that DRAM stores in ``sample_stats``."""

from typing import Any

import numpy as np
from pymc.stats.convergence import SamplerWarning

from ..kernel.record_arrays import N_POPULATION_MOVES
from ..kernel.state import (
    ACCEPTANCE,
    FAILURE,
    INDEPENDENT,
    LOG_DENSITY,
    N_COMMON_BLOCKS,
    N_COUNTS,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_NUMBERS,
    N_SCREEN_FAILED,
    N_SCREENED,
    SCALING,
    STAGE,
    ChainState,
    Draws,
    n_accepted,
)
from ..target.record_target import RecordTarget
from ..target.target import Target

# PyMC's names: it renames the first to "lp", and logs and removes the second.
MODEL_LOGP, WARNING = "model_logp", "warning"


_NUMBERS = {"accept": ACCEPTANCE, MODEL_LOGP: LOG_DENSITY, "scaling": SCALING}
_COUNTS = {
    "stage": STAGE,
    "independent": INDEPENDENT,
    "n_evaluations": N_EVALUATIONS,
    "n_failed": N_FAILED,
    "failure": FAILURE,
}
_RECORD_COUNTS = {
    name: column for name, column in _COUNTS.items() if name not in ("stage", "independent")
}
_SCREEN_COUNTS = {"n_screened": N_SCREENED, "n_screen_failed": N_SCREEN_FAILED}


def dtypes(target: Target) -> dict[str, Any]:
    """Dtypes of the statistics, by name."""
    dim, n_noisy = target.raveled.dim, len(target.seed_names)
    counts, seeds = (np.zeros((1, n), dtype=np.int64) for n in (N_COUNTS, n_noisy))
    one = Draws(
        np.zeros((1, dim)), np.zeros((1, N_NUMBERS)), counts, seeds, np.zeros((1, dim, dim))
    )
    # A subarray dtype is the only way to store a matrix per draw as numbers.
    types: dict[str, Any] = {
        name: np.dtype((values.dtype, values.shape[1:]))
        for name, values in of_draws(target, one, slice(0, 1)).items()
    }
    return types | {"accept_rate": np.float64, WARNING: SamplerWarning}


def dtypes_shapes(target: Target) -> dict[str, tuple[Any, Any]]:
    """Dtypes with PyMC's shapes: a scalar, or None for a statistic that some draws lack."""
    return {
        name: (dtype, None if name == WARNING else []) for name, dtype in dtypes(target).items()
    }


def of_draws(target: Target, draws: Draws, rows: int | slice) -> dict[str, Any]:
    """Statistics of one iteration, as numbers, or of several, as arrays.

    Without ``accept_rate``, which depends on earlier iterations, and the warning.
    """
    stats = {name: draws.numbers[rows, column] for name, column in _NUMBERS.items()}
    stats |= {name: draws.counts[rows, column] for name, column in _COUNTS.items()}
    # A float, as in Metropolis: PyMC requires one dtype per name in all steps of a model.
    stats["accepted"] = (stats["stage"] > 0) * 1.0
    stats["exact"] = np.full(stats["stage"].shape, target.exact)
    # Else another DRAM may have another shape, which PyMC refuses.
    if draws.covs.size and target.samples_all:
        stats["proposal_cov"] = draws.covs[rows].copy()
    if target.seed_names:
        stats["n_effective"] = draws.numbers[rows, N_EFFECTIVE]
    if target.carries_noise:  # a seed alone does not reproduce the estimate
        stats["correlation"] = np.full(stats["stage"].shape, target.settings.correlation)
    else:
        stats |= {name: draws.seeds[rows, i] for i, name in enumerate(target.seed_names)}
    if target.screen is not None:
        stats |= {name: draws.counts[rows, column] for name, column in _SCREEN_COUNTS.items()}
    return stats


def whole_chain(
    target: Target | RecordTarget, draws: Draws, state: ChainState, tune: int, thin: int = 1
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Positions and statistics of a whole chain, as copies.

    Each draw after the warm-up is the last of ``thin`` iterations: what is accepted is their share.

    ``proposal_cov`` is a view without a stride if the covariances of the warm-up were not kept.
    """
    if isinstance(target, RecordTarget):
        return draws.positions.copy(), _of_records(target, draws, tune, thin)
    n = len(draws.positions)
    stats = {name: values.copy() for name, values in of_draws(target, draws, slice(0, n)).items()}
    accepted = n_accepted(draws.counts)[:, 0] / _n_behind(n, tune, thin)
    stats |= {"accepted": accepted, "accept_rate": _means_of_phases(accepted, tune)}
    covs = np.broadcast_to(state.proposal_cov, (n, *state.proposal_cov.shape))
    if len(draws.covs):
        covs = np.concatenate([draws.covs[:n], covs[tune:]])
    return draws.positions.copy(), stats | {"proposal_cov": covs}


def _n_behind(n: int, tune: int, thin: int) -> np.ndarray:
    """Iterations behind each of n draws, of which the first are the warm-up."""
    return np.where(np.arange(n) < tune, 1, thin)


def _means_of_phases(values: np.ndarray, tune: int) -> np.ndarray:
    """Means since the beginning of the warm-up, and since its end."""
    phases = np.split(values, [tune])
    return np.concatenate([running_means(of) for of in phases])


def running_means(values: np.ndarray) -> np.ndarray:
    """Means of all values so far, along the last axis."""
    return np.cumsum(values, axis=-1) / np.arange(1, values.shape[-1] + 1)


def _of_records(target: RecordTarget, draws: Draws, tune: int, thin: int) -> dict[str, np.ndarray]:
    """Statistics of a whole chain that moves records one by one."""
    counts, n = draws.counts, len(draws.counts)
    behind = _n_behind(n, tune, thin)
    moved = n_accepted(counts) / behind[:, None]
    accepted = moved.mean(axis=1)
    stats = {name: draws.numbers[:, column].copy() for name, column in _NUMBERS.items()}
    stats |= {name: counts[:, column].copy() for name, column in _RECORD_COUNTS.items()}
    stats |= {
        "accepted": accepted,
        "accept_rate": _means_of_phases(accepted, tune),
        "record_accepted": moved,
        "exact": np.full(n, target.exact),
    }
    if target.structure.shared:
        stats["shared_accepted"] = counts[:, -N_COMMON_BLOCKS] / behind
    if target.structure.population:
        stats["population_accepted"] = counts[:, -1] / N_POPULATION_MOVES / behind
    for column, name in enumerate(target.seed_names):
        seeds = draws.seeds[:, target.layout.columns == column]
        is_of_records = name in stat_dims(target)
        stats[name] = seeds.copy() if is_of_records else seeds[:, 0].copy()
    return stats


def stat_dims(target: Target | RecordTarget) -> dict[str, tuple[str, tuple]]:
    """Name and coordinates of the dimension of statistics that have a value for each record."""
    if isinstance(target, Target):
        return {}
    dim = f"{target.structure.name}_record"
    of_records = target.layout.columns[target.layout.seeds[0]].tolist()
    names = ["record_accepted", *(target.seed_names[column] for column in of_records)]
    return dict.fromkeys(names, (dim, target.labels))
