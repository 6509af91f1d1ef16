"""A run as a DataTree: equally likely draws, their errors, the course of the run, the evidence.

The draws of the posterior are particles of all populations, resampled in proportion to weight and
evidence and kept in their order, so that a chain of the result is nearly a population. All that
takes draws of a posterior takes these.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..checks.coverage.sentences import store as store_unvisited
from ..errors import EvidenceWarning, warn
from ..evidence.evidence import Evidence, store_evidence
from ..evidence.observed_data import Observed, facts_of
from ..filters.protocol import Filter
from ..pymc_model.held_seed import BETWEEN
from ..pymc_model.inspection import exactness, filters_used, noise_seeds
from ..pymc_model.posterior_draws import BY_PARTICLES, COURSE
from ..pymc_model.prior import Support
from ..sampling.output.datatree import to_datatree
from ..sampling.output.deterministics import Deterministics
from ..sampling.target.variables import RaveledVariables
from ..smc.merging import mean_and_error, merged_index, merged_log_evidence
from ..smc.particles import Particles
from ..statistics.importance import normalised
from .particle_request import Request, Run, least_alive

ESTIMATOR = "smc"
ERRORS = "mcse"
# Relative, of the evidences of the populations. Of runs of `benchmarks.smc` that are right it marks
# 17 of 113 with 200 draws, and 8 of 119 with 1000. Populations that have all lost a mode agree.
MAX_SPREAD = 0.7
MIN_ACCEPTANCE = 0.02
_DRAWS = 2**32  # key of random numbers beside those of the run

Array = NDArray[np.float64]
# Of a result, the filter that the run has used (None: those of the model) and its seconds.
DoubtsOf = Callable[[xr.DataTree, Filter | None, float], Sequence[str]]


def as_datatree(
    model: pm.Model,
    run: Run,
    request: Request,
    observed: Sequence[Observed],
    *,
    data: str,
    seconds: float,
    maximum: float,
    doubts_of: DoubtsOf,
    filter: Filter | None = None,
) -> xr.DataTree:
    """The result of a run of a model with the data ``observed``.

    ``maximum`` is the largest log-likelihood found, of the evidence; ``data`` is the way in which
    the data came in; ``doubts_of`` gives the doubts about filters. Warns if the
    populations disagree, or moves are rarely accepted.
    """
    particles = run.cloud.others.particles
    index = merged_index(
        run.cloud.others,
        run.log_evidences,
        request.n_populations * request.draws,
        request.generator(_DRAWS),
    )
    raveled = RaveledVariables(model.value_vars, model.initial_point())
    chains = _chains(model, particles.at(index), index // request.size.n_particles, request)
    tree = to_datatree(
        model, raveled, chains, tune=0, keep_warmup=False, sampling_time=seconds,
        attrs={"sampler": BY_PARTICLES},
    )  # fmt: skip
    merged, error = map(float, merged_log_evidence(run.log_evidences))
    tree[COURSE] = xr.DataTree(run.course.assign(log_evidence=("population", run.log_evidences)))
    tree[ERRORS] = xr.DataTree(_errors(tree, Deterministics(model, raveled)(particles.x), run))
    tree.attrs |= {
        **filters_used(model),
        "exact": int(exactness(model)),
        "sampler": BY_PARTICLES,
        "data": data,
        "log_evidence": merged,
        "log_evidence_se": error,
    }
    if run.missed is not None:
        store_unvisited(tree, run.missed)
    support = Support.of(model)
    doubts = [*support.check(), *_doubts(run)]
    if doubts:
        warn(
            f"the log-evidence {merged:.2f} is less certain than its standard error suggests: "
            f"{'; '.join(doubts)}",
            EvidenceWarning,
            *BETWEEN,
        )
    doubts += doubts_of(tree, filter, seconds)
    evidence = _evidence(model, support, (merged, error), run, observed, maximum, doubts)
    store_evidence(tree, evidence, {"n_populations": float(request.n_populations)})
    return tree


def _chains(
    model: pm.Model, draws: Particles, population: NDArray[np.int64], request: Request
) -> list[tuple[Array, dict[str, np.ndarray]]]:
    """Positions and statistics of the draws, as many in each chain."""
    stats = {"lp": draws.log_density(1.0), "population": population}
    for column, name in enumerate(noise_seeds(model)):
        stats[f"{name}_seed"] = draws.seeds[:, column]
    parts = [
        slice(i * request.draws, (i + 1) * request.draws) for i in range(request.n_populations)
    ]
    return [(draws.x[part], {n: values[part] for n, values in stats.items()}) for part in parts]


def _errors(tree: xr.DataTree, values: dict[str, np.ndarray], run: Run) -> xr.Dataset:
    """The Monte Carlo standard error of the mean of each variable of the posterior."""
    found = {}
    for name, of_particles in values.items():
        mean = tree["posterior"].to_dataset()[name].mean(("chain", "draw"))  # for its coordinates
        error = mean_and_error(of_particles, run.cloud.others, run.log_evidences)[1]
        found[name] = mean.copy(data=error)
    return xr.Dataset(found)


def _evidence(
    model: pm.Model,
    support: Support,
    value_and_error: tuple[float, float],
    run: Run,
    observed: Sequence[Observed],
    maximum: float,
    doubts: Sequence[str],
) -> Evidence:
    return Evidence(
        *value_and_error,
        ESTIMATOR,
        n_parameters=run.cloud.others.particles.x.shape[1],
        max_log_likelihood=maximum,
        noise="refreshed" if noise_seeds(model) else "none",
        doubts="; ".join(doubts),
        approximate=not exactness(model),
        **facts_of(observed, support),
    )


def _doubts(run: Run) -> Iterator[str]:
    """What says that the spread of the populations is no measure of the error."""
    yield from run.missed or ()
    shares = normalised(run.log_evidences)
    spread = float(shares.std(ddof=1) / shares.mean())
    if spread > MAX_SPREAD:
        yield (
            f"the evidences of the populations have a standard deviation of {spread:.2f} of their "
            "mean, so that a few of them decide: raise draws, narrow the priors, or take the "
            "evidence of estimate_evidence, for which the draws need only show where the posterior "
            "lies"
        )
    yield from _few_alive(run)
    least = float(np.nanmin(run.course["acceptance"].values, initial=1.0))
    if least < MIN_ACCEPTANCE:
        yield (
            f"moves are rarely accepted ({least:.1%} at worst): reduce the noise of the likelihood "
            "(more particles of the filter), or raise draws"
        )


def _few_alive(run: Run) -> Iterator[str]:
    """What says that populations had hardly a particle left that can have given a row."""
    if "n_alive" not in run.course:
        return
    least = least_alive(run.cloud)
    few = run.course["n_alive"].transpose("population", "row").values < least
    if few.any():
        yield (
            f"{few.any(axis=1).sum()} of {len(few)} populations had fewer than {least} particles "
            f"of positive likelihood, first at observation {few.any(axis=0).argmax() + 1}: raise "
            "draws, or narrow the priors"
        )
