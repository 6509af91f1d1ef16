"""A whole run of NUTS, from the request to the DataTree."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from pymc.initial_point import make_initial_point_fn
from pymc.model import Model
from xarray import DataTree

from ...errors import ModelError
from ...facts import tell
from ...parallel.cpu_affinity import available_cores
from ...parallel.signals import keeps_what_is_there
from ...pymc_model.elements import element_names
from ...pymc_model.inspection import exactness, filters_used
from ..output.datatree import to_datatree
from ..output.facts import EndedNuts, SeparateModes, of_model
from ..run.request import ExecutionOptions, SamplingRequest
from ..starts.population import find_population
from ..target.initial_points import check_initvals
from ..target.settings import RandomWalkSettings
from ..target.target import Target
from ..target.variables import check_no_generators
from .chains import NutsChains, run_nuts
from .gradient import DensityGradient

Array = NDArray[np.float64]

_OFF_LEVEL = 1e-3  # how far from a user's point, where the density is level there


@keeps_what_is_there
def sample_nuts(
    model: Model, request: SamplingRequest, options: ExecutionOptions, name: str
) -> DataTree:
    """Draw from the posterior by nutpie; errors are those of `sample`, messages have the name."""
    options.check()
    check_no_generators(model)
    _check_initvals(model, request)
    progressbar = options.progressbar
    rng = np.random.default_rng(request.entropy)
    target = Target(model, None, RandomWalkSettings())
    density = DensityGradient(model, target.raveled)
    start = _start(model, target, density, request, rng, name, progressbar=bool(progressbar))
    chains = run_nuts(
        density,
        start,
        target.raveled.dim,
        request,
        cores=options.cores or available_cores(),
        seed=int(rng.integers(2**32)),
        progressbar=progressbar,
    )
    if not chains.positions.shape[1]:
        raise KeyboardInterrupt("the run was interrupted before there was a draw to return")
    tree = _tree(model, target, chains, request)
    ended = EndedNuts(
        model=model,
        target=target,
        request=request,
        tree=tree,
        names=element_names(model, target.raveled.variables),
        length=chains.length,
        seconds=chains.seconds,
        convergence=chains.found,
        positions=chains.positions.reshape(-1, target.raveled.dim),
        rngs=(rng, rng),
        is_checked=True,
        level="info" if progressbar else "debug",
        diverging=chains.statistics["diverging"],
        energy=chains.statistics["energy"],
        n_steps=chains.statistics["n_steps"],
        is_stuck=chains.is_stuck,
        is_complete=chains.is_complete,
    )
    tell(ended, of_model(name))
    return tree


def _check_initvals(model: Model, request: SamplingRequest) -> None:
    initvals = request.initvals
    if initvals is not None and not isinstance(initvals, Mapping):
        raise ModelError(
            f"initvals must be a mapping for sampler='nuts', got {type(initvals).__name__}: "
            "sampler='dram' takes one for each chain"
        )
    check_initvals(model, initvals, request.chains)


def _tree(model: Model, target: Target, chains: NutsChains, request: SamplingRequest) -> DataTree:
    arrays = [
        (positions, {name: values[i] for name, values in chains.statistics.items()})
        for i, positions in enumerate(chains.positions)
    ]
    tree = to_datatree(
        model,
        target.raveled,
        arrays,
        tune=0,
        keep_warmup=False,
        sampling_time=chains.seconds,
    )
    tree["posterior"].attrs["tuning_steps"] = request.tune
    tree.attrs |= {
        **filters_used(model),
        "exact": int(exactness(model)),
        "refresh_noise": 1,
        "correlation": 0.0,
        "iterations_per_draw": chains.length.thin,
    }
    return tree


def _start(
    model: Model,
    target: Target,
    density: DensityGradient,
    request: SamplingRequest,
    rng: np.random.Generator,
    name: str,
    *,
    progressbar: bool,
) -> Callable[[np.random.Generator], Array]:
    """Where a chain starts, by a generator of its own: at a point of the posterior.

    Or at the user's point, or, if a prior is improper, near the model's initial point.
    """
    initvals = request.initvals
    if initvals is not None or not target.prior_draws.may_start:
        point = make_initial_point_fn(model=model, overrides=dict(initvals or {}))
        centre, width = target.raveled.ravel(point(0)), np.ones(target.raveled.dim)
        if initvals:
            # From where the density is level along an element, nutpie knows no scale of it.
            _, gradient = density.for_a_thread()(centre)
            width = np.where(gradient == 0.0, _OFF_LEVEL, 0.0)
        return lambda own: centre + own.uniform(-width, width)
    target.prepare()
    population = find_population(target, rng, progressbar=progressbar)
    tell(SeparateModes(model, target.raveled, population, before_run=True), of_model(name))
    return lambda own: population.x[own.integers(len(population.x))]
