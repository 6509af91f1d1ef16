"""Forward simulation of a system, in machine code."""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import numpy as np
import xarray as xr
from numba import typeof

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.observation_sampler import (
    observation_mean,
    observation_sampler,
)
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import cached_on_disk
from pymc_statespace_filters.compiler.native.jit import copy_into
from pymc_statespace_filters.compiler.native.python_call import call_in_thread, call_machine_code
from pymc_statespace_filters.compiler.numerics.record_noise import generators_of_records
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.records import single_records
from pymc_statespace_filters.parallel.signals import held_interrupts
from pymc_statespace_filters.progress import slow_compilation
from pymc_statespace_filters.system.checks import check_finite, check_flag, check_random_seed
from pymc_statespace_filters.system.model import StateSpaceModel
from pymc_statespace_filters.system.panel import checked_panel, row_coords
from pymc_statespace_filters.system.panel_parameters import panel_parameters
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import check_inputs, check_system
from pymc_statespace_filters.system.steps import steps_of

_MANY_STEPS = 100_000  # some milliseconds at the least


@lru_cache(maxsize=256)
def continuation(system: StateSpaceModel) -> CompiledFunction:
    """The function (rng, theta, x, first, steps, inputs, t0) -> states (R, n), observations (R, p).

    It starts at the state x (n,) of step ``first`` and returns states and observations at
    ``steps``, which increase and are not below ``first``.
    """
    compiled, sampler = compile_system(system), _sampler(system)
    prepare, propagate = compiled.prepare.function, compiled.propagate.function
    observe, dt, n, m, p = sampler.function, system.dt, system.n, compiled.m, system.p

    def run(rng, theta, x, first, steps, inputs, t0):
        c = prepare(theta)
        states, observations = np.empty((steps.size, n)), np.empty((steps.size, p))
        now, k = x.copy().reshape(n, 1), first
        for j in range(steps.size):
            while k < steps[j]:
                propagate(c, inputs, k, t0 + k * dt, rng.standard_normal((m, 1)), now)
                k += 1
            copy_into(states[j], now[:, 0])
            observe(rng, c, inputs, k, t0 + k * dt, now, observations[j])
        return states, observations

    keys = compiled.prepare.key, compiled.propagate.key, sampler.key
    return _cached(run, key_of(__name__, f"continuation {dt!r} {n} {m} {p}", *keys))


@lru_cache(maxsize=256)
def observer(system: StateSpaceModel) -> CompiledFunction:
    """The function (rng, theta, states, steps, inputs, t0) -> an observation (R, p) of each state.

    ``states`` (R, n) are those at ``steps`` (R,).
    """
    constants, sampler = compile_system(system).prepare, _sampler(system)
    prepare, observe, dt, p = constants.function, sampler.function, system.dt, system.p

    def run(rng, theta, states, steps, inputs, t0):
        c, observations = prepare(theta), np.empty((steps.size, p))
        for i in range(steps.size):
            x, k = states[i].copy().reshape(-1, 1), steps[i]
            observe(rng, c, inputs, k, t0 + k * dt, x, observations[i])
        return observations

    return _cached(run, key_of(__name__, f"observer {dt!r} {p}", constants.key, sampler.key))


def _cached(function: Callable, key: str | None) -> CompiledFunction:
    """Compile a function, or load it from disk if it was compiled before."""
    return CompiledFunction(cached_on_disk(jit(function), key), key)


def _sampler(system: StateSpaceModel, noise: bool = True) -> CompiledFunction:
    if system.equations.observation is None and system.equations.observation_draw is None:
        raise ModelError(
            "simulating needs observation and observation_noise, or observation_dist, got a system "
            "with a density of observations alone (observation_logp)"
        )
    return observation_sampler(system) if noise else observation_mean(system)


@jit
def _standard_normals(rng, size):
    return rng.standard_normal((size, 1))


@jit
def _zeros(rng, size):
    return np.zeros((size, 1))


@lru_cache(maxsize=256)
def simulator(system: StateSpaceModel, noise: bool) -> CompiledFunction:
    """The function (rng, theta, steps, inputs, t0) -> (states (K + 1, n), observations (J, p)).

    Without ``noise`` the initial state is its mean, every noise is zero, and ``rng`` is not used.
    """
    sampler = _sampler(system, noise)
    compiled = compile_system(system if noise else system.gaussian)
    parts = compiled.prepare, compiled.initialise, compiled.propagate, sampler
    prepare, initialise, propagate, observe = (part.function for part in parts)
    normals = _standard_normals if noise else _zeros
    dt, n, n_start, m, p = system.dt, system.n, compiled.n_start, compiled.m, system.p
    n_theta = system.n_theta

    def simulate(rng, theta, steps, inputs, t0):
        c = prepare(theta)
        n_steps = steps[-1] if steps.size else 0
        states = np.empty((n_steps + 1, n))
        observations = np.empty((steps.size, p))
        x = np.empty((n, 1))
        if noise:
            initialise(c, normals(rng, n_start), x)
        else:  # by the mean itself: the covariance may be infinite
            copy_into(x[:, 0], c[n_theta : n_theta + n])
        j = 0
        for k in range(n_steps + 1):
            copy_into(states[k], x[:, 0])
            if j < steps.size and steps[j] == k:
                observe(rng, c, inputs, k, t0 + k * dt, x, observations[j])
                j += 1
            if k < n_steps:
                propagate(c, inputs, k, t0 + k * dt, normals(rng, m), x)
        return states, observations

    keys = (part.key for part in parts)
    cached = _cached(
        simulate, key_of(__name__, f"simulate {noise} {dt!r} {n} {n_start} {m} {p}", *keys)
    )
    # At once and not by the first call, which PyMC makes when its bar is on the screen already.
    vector, matrix, steps = np.zeros(1), np.zeros((1, 1)), np.zeros(1, dtype=np.int64)
    arguments = np.random.default_rng(0), vector, steps, matrix, 0.0
    with held_interrupts(), slow_compilation("the simulation of this system"):
        cached.function.compile(tuple(map(typeof, arguments)))
    return cached


def simulate(
    system: StateSpaceModel,
    params: Mapping[str, Any],
    *,
    steps: Any = None,
    times: Any = None,
    panel: Any = None,
    inputs: Any = None,
    t0: float = 0.0,
    noise: bool = True,
    random_seed: Any = None,
) -> xr.Dataset:
    """Simulate one path of the states and its observations, or those of each record of a panel.

    Parameters
    ----------
    system : StateSpaceModel
    params : mapping
        A value for every parameter.
    steps, times : array_like, shape (J,)
        When observations are taken, as steps or as times; give one of them.
    panel : array_like of int or str, shape (J,), optional
        For many records: the label of the record of each observation, see `StateSpace`. Parameters
        are then numbers for all G records, or have a leading dimension G.
    inputs : array_like, shape (rows, n_inputs)
        Row k holds during step k; in a panel, one such array for all records or one for each.
    t0 : float
        Time of step 0.
    noise : bool
        Whether to draw the initial state, process noise and measurement noise. If not, the path
        starts at the initial mean, and ``q`` and ``e`` are zero. What is drawn from
        ``process_dist`` and ``observation_dist`` is then the mean of the distribution, given the
        state and the variables above it.
    random_seed : None, int or numpy.random.Generator
        In a panel, the noise of each record depends on it and on the record's label.

    Returns
    -------
    xarray.Dataset
        ``states`` (step, state) at every step from 0 to the last, ``observations``
        (obs, observable), with the coordinates ``time`` and ``obs_time``. Of a panel,
        ``states`` (row, state) with the coordinates ``record``, ``step`` and ``time`` of each row,
        the records one below the other, and ``observations`` (obs, observable) with
        ``obs_record``, ``obs_step`` and ``obs_time``.

    Raises
    ------
    ModelError
        If an argument is wrong, or PyMC gives no mean of a distribution where ``noise`` is False.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.6]], dt=0.01),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.08]],
    ...     initial_mean=[1.0],
    ...     initial_cov=[[0.5]],
    ... )
    >>> record = psf.simulate(system, {"a": 1.0}, steps=[0, 20, 40], random_seed=1)
    >>> dict(record.sizes)
    {'step': 41, 'state': 1, 'obs': 3, 'observable': 1}
    >>> psf.simulate(system, {"a": 1.0}, steps=[0, 1, 2], noise=False)["states"].values.ravel()
    array([1.    , 0.99  , 0.9801])
    >>> labels, steps = ["A", "A", "A", "B", "B"], [0, 20, 40, 0, 30]
    >>> params = {"a": [1.0, 2.0]}  # of A and B
    >>> panel = psf.simulate(system, params, panel=labels, steps=steps, random_seed=1)
    >>> dict(panel.sizes)
    {'row': 72, 'state': 1, 'obs': 5, 'observable': 1}
    """
    check_system(system)
    if panel is not None:
        data = {"steps": steps, "times": times, "inputs": inputs, "t0": t0}
        return _simulate_panel(system, params, panel, data, noise, random_seed)
    t0 = check_finite("t0", t0)
    at = steps_of(steps, times, system.dt, t0)
    forces = check_inputs(inputs, system, at)
    theta = flat_parameters(system, params)
    if theta.ndim != 1:
        raise ModelError(
            f"simulate takes one value per parameter, got arrays of {theta.shape[:-1]}"
        )
    with_noise = check_flag("noise", noise)
    rng = check_random_seed(random_seed)
    states, observations = _call(simulator(system, with_noise).function, rng, theta, at, forces, t0)
    n_steps = np.arange(states.shape[0])
    return xr.Dataset(
        {
            "states": (("step", "state"), states),
            "observations": (("obs", "observable"), observations),
        },
        coords={
            "step": n_steps,
            "state": list(system.states),
            "obs": at,
            "observable": list(system.observables),
            "time": ("step", t0 + n_steps * system.dt),
            "obs_time": ("obs", t0 + at * system.dt),
        },
    )


def _call(
    run: Callable, rng: np.random.Generator, theta: np.ndarray, steps: Any, *rest: Any
) -> Any:
    """Call a simulator; in a thread if it takes long, so that an interrupt ends the wait."""
    is_long = steps.size > 0 and steps[-1] > _MANY_STEPS
    return (call_in_thread if is_long else call_machine_code)(run, rng, theta, steps, *rest)


def _simulate_panel(
    system: StateSpaceModel,
    params: Mapping[str, Any],
    panel: Any,
    data: Mapping[str, Any],
    noise: bool,
    random_seed: Any,
) -> xr.Dataset:
    """Simulate every record with a generator of its own."""
    unseen = np.full((np.size(panel), system.p), np.nan)
    table = checked_panel(system, panel, unseen, **data)
    theta = panel_parameters(system, params, table.records)
    run = simulator(system, check_flag("noise", noise)).function
    generators = generators_of_records(check_random_seed(random_seed), table.records.codes)
    records = single_records(table, 0)
    simulated = [
        _call(run, rng, own, steps, inputs, float(t0))
        for rng, own, (steps, _, inputs, t0, _) in zip(generators, theta, records, strict=True)
    ]
    states, observations = (np.concatenate(parts) for parts in zip(*simulated, strict=True))
    n_steps = [np.arange(len(path)) for path, _ in simulated]
    coords_of = partial(row_coords, t0=float(table.t0), dt=system.dt)
    labels = table.records.labels
    return xr.Dataset(
        {
            "states": (("row", "state"), states),
            "observations": (("obs", "observable"), observations),
        },
        coords={
            "state": list(system.states),
            "observable": list(system.observables),
            **coords_of("row", labels, n_steps),
            **coords_of("obs", labels, [record[0] for record in records], "obs_"),
        },
    )
