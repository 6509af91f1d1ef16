"""A whole run of NUTS, from the request to the DataTree."""

from collections.abc import Mapping

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
from ..starts.local_scale import local_cov
from ..starts.population import find_population
from ..target.initial_points import check_in_support, check_initvals
from ..target.settings import RandomWalkSettings
from ..target.target import Target
from ..target.variables import check_no_generators
from .chains import NutsChains, run_nuts
from .frame import Frame, WithGradient, frame_of
from .gradient import DensityGradient

Array = NDArray[np.float64]

# How far chains start from a user's point, in its scales: at a mode nutpie would know none.
_OFF_MODE = 0.1
_N_POINTS = 256  # around it, of which each chain takes one


@keeps_what_is_there
def sample_nuts(
    model: Model,
    request: SamplingRequest,
    options: ExecutionOptions,
    name: str,
    points: Array | None = None,
    most_gradients: float = np.inf,
) -> DataTree:
    """Draw from the posterior by nutpie; errors are those of `sample`, messages have the name.

    Chains start among ``points`` (m, d) of the posterior, if there are any.
    """
    options.check()
    check_no_generators(model)
    _check_initvals(model, request)
    rng = np.random.default_rng(request.entropy)
    target = Target(model, None, RandomWalkSettings())
    density = DensityGradient(model, target.raveled)
    evaluate = density.for_a_thread()
    if points is None:
        points, frame = _starts(target, evaluate, request, rng, options, of_model(name))
    else:
        frame = frame_of(points, evaluate, takes_curvature=target.takes_curvature)
    chains = run_nuts(
        density,
        points,
        frame,
        request,
        cores=options.cores or available_cores(),
        seed=int(rng.integers(2**32)),
        progressbar=options.progressbar,
        most_gradients=most_gradients,
    )
    if not (chains.positions.shape[1] or chains.is_beaten):
        raise KeyboardInterrupt("the run was interrupted before there was a draw to return")
    is_empty = chains.is_beaten and chains.found is None
    tree = DataTree() if is_empty else _tree(model, target, chains, request)
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
        options=options,
        diverging=chains.statistics["diverging"],
        energy=chains.statistics["energy"],
        n_steps=chains.statistics["n_steps"],
        is_stuck=chains.is_stuck,
        is_beaten=chains.is_beaten,
        is_complete=chains.is_complete,
        n_gradients=chains.n_gradients,
    )
    options.told(ended, of_model(name))
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


def _starts(
    target: Target,
    evaluate: WithGradient,
    request: SamplingRequest,
    rng: np.random.Generator,
    options: ExecutionOptions,
    begin: str,
) -> tuple[Array, Frame]:
    """Points (m, d) of the posterior, where chains start, and the frame in which they move.

    Or near the user's point, or, if a prior is improper, near the model's initial point.
    """
    model, initvals = target.model, request.initvals
    target.prepare()
    if initvals is None and target.prior_draws.may_start:
        population = find_population(target, rng, progressbar=bool(options.progressbar))
        tell(SeparateModes(model, target.raveled, population, before_run=True), begin)
        x, curved = population.x, target.takes_curvature
        return x, frame_of(x, evaluate, takes_curvature=curved)
    start = make_initial_point_fn(model=model, overrides=dict(initvals or {}))(0)
    check_in_support(model, start, initvals)
    centre = target.raveled.ravel(start)
    frame, width = Frame(centre, np.eye(centre.size)), 1.0
    if initvals:
        if (cov := local_cov(target, centre)) is None:
            raise ModelError("initvals must have a positive density, got a point where it is zero")
        frame, width = frame._replace(factor=np.sqrt(cov)), _OFF_MODE
    return frame.positions(rng.uniform(-width, width, (_N_POINTS, centre.size))), frame
