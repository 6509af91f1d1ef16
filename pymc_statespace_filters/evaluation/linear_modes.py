"""Modes of a system linearised about a rest point, which Newton's method finds."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable
from scipy.optimize import linear_sum_assignment

from ..compiler.lowering.symbols import call, jacobian_of, symbols_of
from ..compiler.native.rows import interpreted_at_points
from ..errors import ModelError
from ..system.checks import shortened
from ..system.equations import as_vector
from ..system.model import StateSpaceModel
from ..system.parameters import flat_parameters
from ..system.record import check_system
from ..system.signature import parameter_symbols

Array = NDArray[np.float64]

MAX_ITERATIONS = 100
MAX_HALVINGS = 30  # of a step of Newton's method that does not lead closer
STEP_TOLERANCE = 1e-12
VALUE_TOLERANCE = 1e-8

INTERVAL = (0.05, 0.95)  # quantiles of the draws
COLUMNS = ("frequency", "damping_ratio", "growth_rate", "time_constant")


class VectorField(NamedTuple):
    """What is zero at a rest point: the drift, or the step less the state before it.

    ``value(theta, x)`` (m, r), ``jacobian(theta, x)`` (m, r, n) and ``start(theta)`` (m, n), the
    initial mean, take m points; inputs, time and noise are zero. ``resting`` are the r states that
    can come to rest: all but accumulators, which sum.
    """

    value: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]
    start: Callable[[Array], Array]
    resting: list[int]
    is_drift: bool
    dt: float


def vector_field(system: StateSpaceModel) -> VectorField:
    """The vector field of a system, from its drift if its integrator has one."""
    if system.drifting:
        names = [one.name for one in system.drifting]
        raise ModelError(
            f"system must have constant parameters, got the drifting {names}: give linear_modes "
            "the system without drift"
        )
    symbols = symbols_of(system)
    theta, x = symbols["theta"], symbols["x"]
    drift = _drift(system, theta, x)
    if drift is None:
        step = system.with_gaussian_steps.equations.transition
        value = call(step, system, {"theta": theta, "x": x}) - x
    else:
        value = drift
    start = call(system.equations.initial_mean, system, {"theta": theta})
    resting = [i for i, name in enumerate(system.states) if name not in system.accumulators]
    value = value[resting]
    return VectorField(
        interpreted_at_points([theta, x], value),
        interpreted_at_points([theta, x], jacobian_of(value, x)),
        interpreted_at_points([theta], start),
        resting,
        drift is not None,
        system.dt,
    )


def _drift(
    system: StateSpaceModel, theta: TensorVariable, x: TensorVariable
) -> TensorVariable | None:
    integrator = system.integrator
    written = getattr(integrator, "drift", None)
    if integrator is None or written is None:
        return None
    (equation,) = (e for e in integrator.equations if e.function is written)
    values = parameter_symbols(theta, system.parameters, system.parameter_shapes)
    given = {"x": x, "u": pt.zeros((system.n_inputs,)), "t": pt.zeros(())}
    return as_vector("drift", equation(values | given), system.n)


def rest_points(system: StateSpaceModel, field: VectorField, theta: Array, several: bool) -> Array:
    """A rest point (m, n) for every row of parameters, from the initial mean on.

    If there are ``several``, the first row is the median of the others.
    """
    x = field.start(theta)
    with np.errstate(all="ignore"):
        value, jacobian = field.value(theta, x), field.jacobian(theta, x)
        for _ in range(MAX_ITERATIONS):
            step = _newton_step(jacobian, value)
            if (_norm(step) <= STEP_TOLERANCE * (1 + _norm(x))).all():
                break
            before, (x, value) = x, _move(field, theta, x, value, step)
            if (x == before).all():  # nothing leads closer
                break
            jacobian = field.jacobian(theta, x)
        scale = np.abs(jacobian).max(axis=(1, 2)) * (1 + _norm(x))
        found = (_norm(value) <= VALUE_TOLERANCE * scale) | (_norm(value) == 0)
    if not found.all():
        start = field.start(theta)[~found][0].tolist()
        raise ModelError(
            f"the system must come to rest somewhere, got no rest point{_where(found, several)} by "
            f"Newton's method from the initial mean {start} with zero inputs: give at=, the state "
            "about which to linearise"
        )
    return x


def _where(found: NDArray[np.bool_], several: bool) -> str:
    if not several:
        return ""
    n_failed = (~found[1:]).sum()
    if not n_failed:
        return " at the median of the parameters"
    return f" at {n_failed} of {len(found) - 1} draws"


def _newton_step(jacobian: Array, value: Array) -> Array:
    """The least step that solves the linearised equations best; 0 where they are not finite."""
    finite = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(value).all(axis=1)
    step = np.zeros(jacobian.shape[::2])
    # The pseudoinverse, because rest points may fill a line: a position that no spring holds.
    step[finite] = -(np.linalg.pinv(jacobian[finite]) @ value[finite, :, None])[..., 0]
    return step


def _move(
    field: VectorField, theta: Array, x: Array, value: Array, step: Array
) -> tuple[Array, Array]:
    """The points after the longest of the steps, halved if need be, that lowers the value."""
    length = np.ones((len(x), 1))
    for _ in range(MAX_HALVINGS):
        moved = x + length * step
        new = field.value(theta, moved)
        worse = ~(_norm(new) < _norm(value)) & (_norm(step) > 0)
        if not worse.any():
            return moved, new
        length[worse] /= 2
    stay = worse[:, None]
    return np.where(stay, x, moved), np.where(stay, value, new)


def _norm(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1)


def linear_modes(system: StateSpaceModel, params: Any, *, at: Any = None) -> pd.DataFrame:
    r"""Frequencies, damping and growth of the modes of a system linearised about a rest point.

    Small deviations from a rest point are sums of modes, :math:`e^{s t}` for each eigenvalue
    :math:`s = \sigma + i \omega`.

    Parameters
    ----------
    system : StateSpaceModel
    params : mapping, xarray.Dataset or xarray.DataTree
        A number or an array of draws for every parameter; or a posterior, or a DataTree with one,
        whose variables have the names of the parameters. If they have others, give a mapping:
        ``{"k": idata["posterior"]["stiffness"], ...}``.
    at : array_like, shape (n,), optional
        The state about which to linearise, taken as it is. By default the rest point, for zero
        inputs at time 0, that Newton's method finds from the initial mean, at every draw.

    Returns
    -------
    pandas.DataFrame
        One row per mode, a conjugate pair being one mode, by frequency:

        * ``frequency``: :math:`|\omega| / 2 \pi`, cycles per unit of time; 0 without oscillation.
        * ``damping_ratio``: :math:`-\sigma / |s|`; 1 for a decay without oscillation, below 1 for
          one with it, negative for a growing mode, NaN for :math:`s = 0`. The frequency without
          damping is ``frequency / sqrt(1 - damping_ratio**2)``.
        * ``growth_rate``: :math:`\sigma`, per unit of time; negative for a mode that decays.
        * ``time_constant``: :math:`1 / |\sigma|`, in which the amplitude changes by a factor of e.

        Given draws, these are medians, each followed by the ends of its central 90 % interval
        (``frequency_low``, ``frequency_high``, ...); ``modes.T`` shows them one below the other.
        ``attrs["at"]`` is the state (at the median of the parameters), and
        ``attrs["eigenvalues_of"]`` is "drift" or "step".

    Raises
    ------
    ModelError
        If there is no rest point, or the equations have no finite derivatives there.

    Notes
    -----
    The eigenvalues are those of the drift's Jacobian, if the integrator has one: they are modes of
    the differential equation, whatever the step length. Otherwise, and for a system that was
    unpickled and knows only its steps, they are :math:`\log(\lambda) / dt` of the eigenvalues
    :math:`\lambda` of the step's Jacobian, exact for equations in discrete time; a negative
    :math:`\lambda` oscillates with the frequency ``1 / (2 * dt)``.

    Modes of different draws are matched to those at the median of every parameter, by the
    assignment of eigenvalues that has the least sum of distances in the complex plane. A mode that
    oscillates at the median and is overdamped at some draws has one of their two decays there;
    the other is not in the table.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(
    ...         lambda x, k, c: [x[1], -k * x[0] - c * x[1]], [[0.0], [0.1]], dt=0.01
    ...     ),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[1.0, 0.0],
    ...     initial_cov=[[0.1, 0.0], [0.0, 0.1]],
    ... )
    >>> psf.mechanics.linear_modes(system, {"k": 4.0, "c": 0.2}).round(3)
          frequency  damping_ratio  growth_rate  time_constant
    mode
    0         0.318           0.05         -0.1           10.0
    """
    check_system(system)
    theta = _parameters(system, params)
    several = theta.ndim > 1
    draws = theta.reshape(int(np.prod(theta.shape[:-1])), system.n_theta)
    if several:  # the modes at the median come first; those of the draws are matched to them
        draws = np.vstack([np.median(draws, axis=0), draws])
    field = vector_field(system)
    points = (
        rest_points(system, field, draws, several) if at is None else _states(system, at, draws)
    )
    eigenvalues = _matched(_eigenvalues(field, draws, points))
    modes = _modes(field, eigenvalues)
    table = _with_intervals(modes[1:]) if several else pd.DataFrame(modes[0], columns=COLUMNS)
    table.index.name = "mode"
    table.attrs = {
        "at": dict(zip(system.states, map(float, points[0]), strict=True)),
        "eigenvalues_of": "drift" if field.is_drift else "step",
    }
    return table


def _parameters(system: StateSpaceModel, params: Any) -> Array:
    """Flat parameters (k,), or those of draws (..., k)."""
    if isinstance(params, xr.DataTree):
        if "posterior" not in params.children:
            raise ModelError(f"params must have a group 'posterior', got {sorted(params.children)}")
        params = params["posterior"].to_dataset()
    if isinstance(params, xr.Dataset):
        first = [dim for dim in ("chain", "draw") if dim in params.dims]
        params = {
            name: params[name].transpose(*first, ..., missing_dims="ignore")
            for name in system.parameters
            if name in params
        }
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        _check_dims(name, shape, params)
    return flat_parameters(system, params)


def _check_dims(name: str, shape: tuple[int, ...], params: Any) -> None:
    """Raise if a parameter has a value for each record of a panel, which would count as draws."""
    value = params.get(name) if isinstance(params, Mapping) else None
    if not isinstance(value, xr.DataArray):
        return
    others = [str(dim) for dim in value.dims if dim not in ("chain", "draw")]
    if len(others) > len(shape):
        raise ModelError(
            f"params must hold one value of {name!r} for each draw, got the dimension {others[0]!r}"
            f" too: select one record, as in posterior.isel({others[0]}=0)"
        )


def _states(system: StateSpaceModel, at: Any, draws: Array) -> Array:
    try:
        state = np.asarray(at, dtype="float64")
    except (TypeError, ValueError):
        state = np.array(np.nan)
    if state.shape != (system.n,) or not np.isfinite(state).all():
        raise ModelError(
            f"at must have a finite number for each of the states {list(system.states)}, got "
            f"{shortened(at)}"
        )
    return np.broadcast_to(state, (len(draws), system.n))


def _eigenvalues(field: VectorField, draws: Array, points: Array) -> NDArray[np.complex128]:
    jacobians = field.jacobian(draws, points)[:, :, field.resting]
    finite = np.isfinite(jacobians).all(axis=(1, 2))
    if not finite.all():
        raise ModelError(
            "the equations must have finite derivatives at the state about which they are "
            f"linearised, got others at {shortened(points[~finite][0].tolist())}"
        )
    return np.linalg.eigvals(jacobians).astype(complex)


def _matched(eigenvalues: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Those of every row in the order of the first row's, without its lower half plane."""
    matched = eigenvalues.copy()
    for i, found in enumerate(eigenvalues[1:], 1):
        distances = np.abs(eigenvalues[0][:, None] - found)
        matched[i] = found[linear_sum_assignment(distances)[1]]
    return matched[:, eigenvalues[0].imag >= 0]


def _modes(field: VectorField, eigenvalues: NDArray[np.complex128]) -> Array:
    """Each of `COLUMNS` (draws, modes, columns), modes by frequency in the first row."""
    with np.errstate(divide="ignore", invalid="ignore"):
        s, dt = (eigenvalues, 1.0) if field.is_drift else (np.log(1.0 + eigenvalues), field.dt)
        growth, turning = s.real / dt, np.abs(s.imag) / dt
        # A mode that ends with a step decays without oscillation, at an infinite rate.
        damping = np.where(np.isinf(growth), 1.0, -growth / np.hypot(growth, turning))
        modes = np.stack([turning / (2 * np.pi), damping, growth, 1 / np.abs(growth)], axis=-1)
    return modes[:, np.lexsort((-growth[0], turning[0]))]


def _with_intervals(modes: Array) -> pd.DataFrame:
    ends = np.quantile(modes, INTERVAL, axis=0)
    middle = np.median(modes, axis=0)
    return pd.DataFrame(
        {
            f"{name}{suffix}": values[:, i]
            for i, name in enumerate(COLUMNS)
            for suffix, values in (("", middle), ("_low", ends[0]), ("_high", ends[1]))
        }
    )
