"""Forward simulation of a system, in machine code."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ..compiler.codegen.arguments import MemberArguments
from ..compiler.codegen.function_types import CompiledFunction, jit
from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.observation import distribution_sampler
from ..compiler.native.cache_key import key_of
from ..compiler.native.entry_point import address_of, cached_on_disk, call_address
from ..compiler.native.jit import copy_into
from ..compiler.native.python_call import call_in_thread, call_machine_code
from ..compiler.numerics.philox import generators_of_records
from ..errors import ModelError, ModelWarning, warn
from ..parallel.signals import held_interrupts
from ..progress import slow_compilation
from ..system.checks import check_flag, check_random_seed
from ..system.given_record import GivenRecord
from ..system.model import StateSpaceModel
from ..system.own_units import in_own_units
from ..system.parameters import panel_parameters
from ..system.record import Record, check_system, read_record

_MANY_STEPS = 100_000  # some milliseconds at the least


class _Functions(NamedTuple):
    """Addresses of the functions of a system, and sizes; ``initialise`` is 0 without noise."""

    prepare: int
    initialise: int
    propagate: int
    observe: int
    n: int
    n_start: int
    m: int
    r: int
    p: int
    n_theta: int
    n_constants: int


class Simulator(NamedTuple):
    """A loop over the steps of one system: for Python, and for functions that numba compiles."""

    function: Callable
    jitted: CompiledFunction


@jit
def _call(address, c, inputs, k, t, z, X, out):
    arguments = MemberArguments(
        c=c, inputs=inputs, k=k, t=t, z=z, width=np.int64(1), X=X, out=out, n_members=np.int64(1)
    )
    call_address(address, arguments)


@jit
def _draw(rng, functions, z):
    """Set z to standard normals for one member; it stays as it is without noise."""
    if functions.initialise != 0:
        for i in range(z.size):
            z[i] = rng.standard_normal()


@jit
def _constants(functions, theta):
    c = np.empty(functions.n_constants)
    call_address(functions.prepare, (theta, np.int64(theta.size), c))
    return c


@jit
def _observe_by_address(rng, functions, c, inputs, k, t, x, out):
    z = np.zeros(functions.r)
    _draw(rng, functions, z)
    _call(functions.observe, c, inputs, k, t, z, x, out)


def _simulation(observe: Any) -> Callable:
    def simulate(rng, functions, dt, theta, steps, inputs, t0):
        c = _constants(functions, theta)
        n_steps = steps[-1] if steps.size else 0
        states = np.empty((n_steps + 1, functions.n))
        observations = np.empty((steps.size, functions.p))
        x, z = np.empty((functions.n, 1)), np.zeros(functions.m)
        if functions.initialise != 0:
            start = np.zeros(functions.n_start)
            _draw(rng, functions, start)
            _call(functions.initialise, c, inputs, np.int64(0), t0, start, x, x)
        else:  # by the mean itself: the covariance may be infinite
            copy_into(x[:, 0], c[functions.n_theta : functions.n_theta + functions.n])
        j = 0
        for k in range(n_steps + 1):
            copy_into(states[k], x[:, 0])
            t = t0 + k * dt
            if j < steps.size and steps[j] == k:
                observe(rng, functions, c, inputs, k, t, x, observations[j])
                j += 1
            if k < n_steps:
                _draw(rng, functions, z)
                _call(functions.propagate, c, inputs, k, t, z, x, x)
        return states, observations

    return simulate


def _continuation(observe: Any) -> Callable:
    def run(rng, functions, dt, theta, x, first, steps, inputs, t0):
        c, n, p = _constants(functions, theta), functions.n, functions.p
        states, observations = np.empty((steps.size, n)), np.empty((steps.size, p))
        now, z, k = x.copy().reshape(n, 1), np.zeros(functions.m), first
        for j in range(steps.size):
            while k < steps[j]:
                _draw(rng, functions, z)
                _call(functions.propagate, c, inputs, k, t0 + k * dt, z, now, now)
                k += 1
            copy_into(states[j], now[:, 0])
            observe(rng, functions, c, inputs, k, t0 + k * dt, now, observations[j])
        return states, observations

    return run


def _observations(observe: Any) -> Callable:
    def run(rng, functions, dt, theta, states, steps, inputs, t0):
        c, observations = _constants(functions, theta[0]), np.empty((steps.size, functions.p))
        for i in range(steps.size):
            if i > 0 and len(theta) > 1:
                c = _constants(functions, theta[i])
            x, k = states[i].copy().reshape(-1, 1), steps[i]
            observe(rng, functions, c, inputs, k, t0 + k * dt, x, observations[i])
        return observations

    return run


def _loop(make: Callable, observe: CompiledFunction) -> CompiledFunction:
    """A loop over steps, compiled once for all systems whose observations are a function."""
    loop = cached_on_disk(jit(make(observe.function)), observe.key)
    return CompiledFunction(loop, key_of(__name__, make.__name__, observe.key))


_BY_ADDRESS = CompiledFunction(_observe_by_address, key_of(__name__, "observe by address"))
_LOOPS = {
    make: _loop(make, _BY_ADDRESS) for make in (_simulation, _continuation, _observations)
}  # fmt: skip


def _simulator(system: StateSpaceModel, make: Callable, noise: bool = True) -> Simulator:
    equations = system.equations
    if equations.observation is None and equations.observation_draw is None:
        raise ModelError(
            "simulating needs observation and observation_noise, or observation_dist, got a system "
            "with a density of observations alone (observation_logp)"
        )
    compiled = compile_system(system if noise else system.gaussian)
    names, loop = ["prepare", "initialise" if noise else "", "propagate"], _LOOPS[make]
    if noise and equations.observation_draw is not None:
        loop = _loop(make, distribution_sampler(system, equations.observation_draw))
        names.append("")
    else:
        names.append("observe" if noise else "expect")
    entries = [compiled.entry_point(name) if name else None for name in names]
    for entry in filter(None, entries):
        entry.compile()
    sizes = (
        system.n, compiled.n_start, compiled.m, compiled.r if noise else 0, system.p,
        system.n_theta, compiled.n_constants,
    )  # fmt: skip
    functions = _Functions._make([*(e.address if e else 0 for e in entries), *sizes])
    prepare, initialise, propagate, observe = (e.symbol if e else "" for e in entries)
    run, dt = loop.function, system.dt

    @jit
    def jitted(rng, *arguments):
        functions = _Functions(
            address_of(prepare), address_of(initialise), address_of(propagate),
            address_of(observe), *sizes,
        )  # fmt: skip
        return run(rng, functions, dt, *arguments)

    keys = (entry.key for entry in entries if entry)
    key = key_of(__name__, repr((dt, sizes)), loop.key, *keys)
    return Simulator(
        lambda rng, *rest: run(rng, functions, dt, *rest), CompiledFunction(jitted, key)
    )


@lru_cache(maxsize=256)
def continuation(system: StateSpaceModel) -> Simulator:
    """The function (rng, theta, x, first, steps, inputs, t0) -> states (R, n), observations (R, p).

    It starts at the state x (n,) of step ``first`` and returns states and observations at
    ``steps``, which increase and are not below ``first``.
    """
    return _simulator(system, _continuation)


@lru_cache(maxsize=256)
def observer(system: StateSpaceModel) -> Simulator:
    """The function (rng, theta, states, steps, inputs, t0) -> an observation (R, p) of each state.

    ``states`` (R, n) are those at ``steps`` (R,), and theta (R, k) or (1, k) those of all.
    """
    return _simulator(system, _observations)


@lru_cache(maxsize=256)
def simulator(system: StateSpaceModel, noise: bool) -> Simulator:
    """The function (rng, theta, steps, inputs, t0) -> (states (K + 1, n), observations (J, p)).

    Without ``noise`` the initial state is its mean, every noise is zero, and ``rng`` is not used.
    """
    with held_interrupts(), slow_compilation("the simulation of this system"):
        found = _simulator(system, _simulation, noise)
        # At once and not when PyMC calls it, whose bar is on the screen already.
        at_start, steps = np.zeros(system.n_theta), np.zeros(0, dtype=np.int64)
        found.function(np.random.default_rng(0), at_start, steps, np.zeros((1, 1)), 0.0)
    return found


def simulate(
    system: StateSpaceModel,
    params: Mapping[str, Any],
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
    t0, unit, input_times, inputs_at, events
        See `StateSpace`.
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

    Warns
    -----
    ModelWarning
        If observations are not finite: the state overflows, or parameters are out of their domain.

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
    given = GivenRecord(None, panel, steps, times, inputs, t0, unit, input_times, inputs_at, events)
    record = read_record(system, given)
    system, records = record.system, record.records
    parameters = panel_parameters(system, params, records)
    run = simulator(system, check_flag("noise", noise)).function
    rng = check_random_seed(random_seed)
    own_rngs = generators_of_records(rng, records.codes) if record.is_panel else [rng]
    simulated = [
        _run(run, own_rng, theta, at, rows, float(t0))
        for own_rng, theta, (at, _, rows, t0) in zip(
            own_rngs, parameters, record.each(), strict=True
        )
    ]
    states, observations = (np.concatenate(parts) for parts in zip(*simulated, strict=True))
    _warn_unless_finite(observations, record)
    dim = "row" if record.is_panel else "step"
    return xr.Dataset(
        {
            "states": ((dim, "state"), in_own_units(system, states)),
            "observations": (("obs", "observable"), observations),
        },
        coords={
            "state": list(system.states),
            "observable": list(system.observables),
            **record.coords(dim, [np.arange(len(path)) for path, _ in simulated]),
            **record.coords("obs", [axis.steps for axis in record.axes], "obs_"),
        },
    )


def _run(run: Callable, rng: np.random.Generator, theta: np.ndarray, steps: Any, *rest: Any) -> Any:
    """Call a simulator; in a thread if it takes long, so that an interrupt ends the wait."""
    is_long = steps.size > 0 and steps[-1] > _MANY_STEPS
    return (call_in_thread if is_long else call_machine_code)(run, rng, theta, steps, *rest)


def _warn_unless_finite(observations: np.ndarray, record: Record) -> None:
    """Warn of numbers that a filter would take for missing observations, or refuse."""
    if (failed := np.flatnonzero(~np.isfinite(observations).all(axis=1))).size:
        row = int(failed[0])
        place = f"at time {record.times([axis.steps for axis in record.axes])[row]}"
        if record.is_panel:
            place = f"of record {record.records.labels[record.records.of_rows()[row]]!r}"
        warn(
            f"{failed.size} of {len(observations)} simulated observations are not finite, the "
            f"first in row {row}, {place}: the state overflows, or a covariance or a "
            "parameter of a distribution is invalid at these parameters. A filter takes NaN for a "
            "missing observation.",
            ModelWarning,
        )
