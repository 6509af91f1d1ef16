"""`online`: a filter that takes the rows of a record as they come, without PyMC.

At a single point the arguments and results of the machine code lie in memory that every row uses
again, so that a row costs microseconds. Draws of a posterior are a mixture whose weights follow the
likelihood of the rows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from ..filters.checks import check_choice
from ..filters.outcomes import NONE, Failure
from ..filters.protocol import Filter
from ..system.checks import check_random_seed
from ..system.clock import Clock, are_dates, clock_and_start
from ..system.model import StateSpaceModel
from ..system.parameters import flat_parameters
from .filter_steps import FilterSteps, Step, filter_steps
from .row_steps import Place, RowSteps, numbers_of_row

Array = NDArray[np.float64]


class Row(NamedTuple):
    """What a row of observations tells.

    Attributes
    ----------
    log_likelihood : float
        log p(d_j | d_1 .. d_{j-1}); over draws, of their mixture.
    mean : ndarray, shape (n,)
        Of the state, given the rows so far.
    cov : ndarray, shape (n, n)
    n_effective : float
        Effective number of draws of the parameters, 1 of a single point.
    n_particles : float
        Effective number of particles behind the row, at the draw where it is smallest. Below 3 the
        filter has collapsed: give it more particles. Infinite without particles.
    """

    log_likelihood: float
    mean: Array
    cov: Array
    n_effective: float
    n_particles: float


class Prediction(NamedTuple):
    """Mean (n,) and covariance (n, n) of the state at a later step, given the rows so far."""

    mean: Array
    cov: Array


@dataclass(frozen=True)
class OnlineState:
    """Where an online filter stands: a value that pickles, and from which another one goes on."""

    identity: tuple[str, str, str]  # of the system, the filter and all parameters
    theta: Array
    seeds: NDArray[np.int64]
    log_weights: Array
    left: list[Array]  # by the filter at each point; of length 0 before the first row
    step: int
    time: float
    t0: float
    resets: Array
    is_on_grid: bool
    clock: Clock


class OnlineFilter:
    """A filter that takes rows as they come, see `online`."""

    def __init__(self, system: StateSpaceModel, filter: Filter, state: OnlineState) -> None:
        self._system, self._filter, self._start = system, filter, state
        self._theta, self._seeds, self._log_weights = state.theta, state.seeds, state.log_weights
        at, is_on_grid = (state.t0, state.step, state.time, state.resets), state.is_on_grid
        self._steps = RowSteps(system, *at, is_on_grid=is_on_grid)
        self._points = self._points_from(state.left, is_on_grid)

    def _points_from(self, left: list[Array], is_on_grid: bool) -> FilterSteps:
        system = self._steps.system_of(is_on_grid)
        return filter_steps(system, self._filter, self._theta, self._seeds, self._start.t0, left)

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy stands where this one does, in memory of its own."""
        return OnlineFilter, (self._system, self._filter, self.state)

    @property
    def state(self) -> OnlineState:
        """Where the filter stands, to be given to `online` elsewhere or later."""
        return OnlineState(
            self._start.identity, self._theta, self._seeds, self._log_weights, self._points.left,
            self._steps.step, self._steps.time, self._start.t0, self._steps.resets,
            self._steps.is_on_grid, self._start.clock,
        )  # fmt: skip

    def update(
        self,
        observed: Any,
        *,
        step: int | None = None,
        time: Any = None,
        inputs: Any = None,
    ) -> Row:
        """Take a row of observations.

        Parameters
        ----------
        observed : float or array_like, shape (p,)
            NaN marks a missing component; a Series is aligned with ``observables`` by its index.
            Of a row that is all NaN the log-likelihood is 0.
        step : int
            The row's step, later than that of the row before. Or give `time`.
        time : float or date
            The row's time. Off the grid ``t0 + k * dt`` the gap is divided into the fewest equal
            steps of at most ``dt``, as by `log_likelihood`. A date where ``t0`` is one.
        inputs : array_like, optional
            A row for each step since the last row of observations, or one for all of them; one more
            if the observation has the argument u.

        Returns
        -------
        Row

        Raises
        ------
        ModelError
            If the row is not later than the last one, or has a density of zero. The filter then
            stands where it was.
        """
        datum = self._checked(observed)
        place, points, found = self._evaluated(datum, step, time, inputs)
        terms, codes, n_particles, mean, cov = found
        if len(codes) > 1:
            return self._mixed(datum, place, points, found)
        if codes[0] != NONE:
            raise _without_likelihood(place, codes)
        points.keep()
        self._points = points
        self._steps.passed(place, datum)
        return Row(float(terms[0]), mean[0], cov[0], 1.0, float(n_particles[0]))

    def advance(
        self, *, step: int | None = None, time: Any = None, inputs: Any = None
    ) -> Prediction:
        """Stand at a later step or time without a row, as where an input changes.

        Arguments are of `update`, and the state there is that of `predict`.
        """
        missing = np.full(self._system.p, np.nan)
        place, points, found = self._evaluated(missing, step, time, inputs)
        prediction = self._predicted(place, found)
        self._stand(place, points, found.codes == NONE, self._log_weights, None)
        return prediction

    def _evaluated(
        self, datum: Array, step: int | None, time: Any, inputs: Any
    ) -> tuple[Place, FilterSteps, Step]:
        """A row at all points, from where the filter stands."""
        clock = self._start.clock
        if time is not None and (clock.unit is not None or are_dates(time)):
            if clock.unit is None:
                raise ModelError(
                    f"time must be a number, as t0 is, got {time!r}: give online t0 as a date, too"
                )
            time = float(clock.numbers("time", [time])[0])
        place, points = self._steps.place(step, time), self._points
        if place.is_on_grid != self._steps.is_on_grid:  # the first row off the grid
            points = self._points_from(points.left, place.is_on_grid)
        return place, points, points(place.step, datum, self._steps.rows(place, inputs))

    def _mixed(self, datum: Array, place: Place, points: FilterSteps, found: Step) -> Row:
        """The row of several draws."""
        terms, codes, n_particles, mean, cov = found
        is_alive = codes == NONE
        if not is_alive.any():
            raise _without_likelihood(place, codes)
        log_weights = self._log_weights + np.where(is_alive, terms, -np.inf)
        log_likelihood = self._stand(place, points, is_alive, log_weights, datum)
        weights = np.exp(self._log_weights)
        moments = _mixture(weights, mean[is_alive], cov[is_alive])
        n_effective = float(1.0 / np.square(weights).sum())
        return Row(log_likelihood, *moments, n_effective, float(n_particles[is_alive].min()))

    def _stand(
        self,
        place: Place,
        points: FilterSteps,
        is_alive: NDArray[np.bool_],
        log_weights: Array,
        datum: Array | None,
    ) -> float:
        """Stand at a place, of draws at those alone that have not failed; the log of their sum."""
        points.keep(None if is_alive.all() else is_alive)
        self._theta, self._seeds = self._theta[is_alive], self._seeds[is_alive]
        total = float(np.logaddexp.reduce(log_weights[is_alive]))
        self._log_weights, self._points = log_weights[is_alive] - total, points
        self._steps.passed(place, datum)
        return total

    def predict(
        self, *, step: int | None = None, time: Any = None, inputs: Any = None
    ) -> Prediction:
        """The state at a later step or time, given the rows so far; arguments as of `update`."""
        missing = np.full(self._system.p, np.nan)
        place, _, found = self._evaluated(missing, step, time, inputs)
        return self._predicted(place, found)

    def _predicted(self, place: Place, found: Step) -> Prediction:
        _, codes, _, mean, cov = found
        is_alive = codes == NONE
        if not is_alive.any():
            raise _failed(f"there is no prediction at step {place.step}", codes)
        weights = np.exp(self._log_weights[is_alive])
        return Prediction(*_mixture(weights / weights.sum(), mean[is_alive], cov[is_alive]))

    def _checked(self, observed: Any) -> Array:
        is_plain = type(observed) is np.ndarray and observed.dtype == np.float64
        if not (is_plain or type(observed) is float):
            observed = numbers_of_row("observed", observed, self._system.observables, "observables")
        datum = np.asarray(observed).reshape(-1)
        if datum.size != self._system.p:
            raise ModelError(
                f"observed must have a number for each of {list(self._system.observables)}, got "
                f"{observed!r}"
            )
        numbers = datum.tolist()
        if any(map(math.isinf, numbers)):
            raise ModelError(f"observed must be finite, or NaN where it is missing, got {numbers}")
        return datum


def online(
    system: StateSpaceModel,
    filter: Filter,
    params: Mapping[str, Any],
    *,
    state: OnlineState | None = None,
    t0: Any = None,
    unit: Any = None,
    random_seed: int | np.random.Generator | None = None,
) -> OnlineFilter:
    """Make a filter that takes the rows of a record as they come.

    Parameters
    ----------
    system : StateSpaceModel
    filter : a filter of the package, or a user's own
    params : mapping
        Parameter values by name; or draws of them, arrays with leading dimensions, such as chain
        and draw (a declared parameter's own shape comes last). Draws are a mixture with equal
        weights at the start, which follow the likelihood of the rows.
    state : OnlineState, optional
        The ``state`` of another online filter of this system, filter and parameters, to go on from.
        It has its own ``t0``, ``unit`` and noise.
    t0 : float or date, optional
        The time of step 0, where ``initial_mean`` and ``initial_cov`` hold. Default: 0.
    unit : str or pandas.Timedelta, optional
        Where times are dates, the duration of one unit of ``dt``, such as "D"; ``t0`` is a date.
    random_seed : int or numpy.random.Generator, optional
        Of the noise inside the filter.

    Returns
    -------
    OnlineFilter
        ``update(observed, step= | time=, inputs=None)`` gives a `Row`, ``predict(step= | time=,
        inputs=None)`` a `Prediction`, as does ``advance``, which stands there; ``state`` pickles.

    Raises
    ------
    ModelError
        If the filter cannot treat the system or cannot go on from a state, parameters do not fit,
        or the state is of another system, filter or parameters or comes with `t0`, `unit` or
        `random_seed`.

    Notes
    -----
    Rows on the grid have the bits of `run_filter` over all rows; `FiniteStateFilter` differs by
    rounding, and `GridFilter` within its tolerance. `GuidedPF`, whose particles move by the rows to
    come, sees one at a time: its estimate is another one, unbiased as well.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(lambda x, k: [x[1], -k * x[0]], [[0.0], [0.3]], dt=0.1),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[1.0, 0.0],
    ...     initial_cov=[[0.1, 0.0], [0.0, 0.1]],
    ... )
    >>> tracker = psf.online(system, psf.EKF(), {"k": 2.0})
    >>> row = tracker.update(0.98, step=1)
    >>> row.mean.shape, row.cov.shape
    ((2,), (2, 2))
    >>> later = psf.online(system, psf.EKF(), {"k": 2.0}, state=tracker.state)
    >>> same = later.update(0.95, step=2), tracker.update(0.95, step=2)
    >>> same[0].log_likelihood == same[1].log_likelihood
    True
    """
    check_choice(system, filter)
    if system.events is not None:
        raise ModelError(
            "online takes no events, and this system has some: run_filter(state=, events=) goes on "
            "across them"
        )
    theta = flat_parameters(system, params)
    theta = theta.reshape(math.prod(theta.shape[:-1]), theta.shape[-1])  # of all chains
    if not len(theta):
        raise ModelError("params must be numbers or draws, got arrays of length 0")
    identity = system.fingerprint, repr(filter), blake2b(theta.tobytes()).hexdigest()
    if state is not None:
        if not isinstance(state, OnlineState):
            raise ModelError(f"state must be that of an online filter, got {type(state).__name__}")
        if state.identity[:2] != identity[:2]:
            raise ModelError("state must be of the same system and filter, got one of another")
        if state.identity != identity:
            raise ModelError("state must be of the same parameters, got one of others")
        own = {"t0": t0, "unit": unit, "random_seed": random_seed}
        for name, value in own.items():
            if value is not None:
                raise ModelError(f"{name} must be None with state, which has its own")
        return OnlineFilter(system, filter, state)
    rng = check_random_seed(random_seed)
    seeds = rng.integers(np.iinfo(np.int64).max, size=len(theta))
    weights = np.full(len(theta), -math.log(len(theta)))
    dates = [[t0]] if are_dates(t0) else None  # the first of them
    clock, t0 = clock_and_start(dates, 0.0 if t0 is None else t0, unit, "t0 and times")
    resets = np.zeros(len(system.accumulators))
    nothing = [np.empty(0)] * len(theta)
    start = OnlineState(identity, theta, seeds, weights, nothing, -1, t0, t0, resets, True, clock)
    return OnlineFilter(system, filter, start)


def _mixture(weights: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture of laws with these means (m, n) and covariances."""
    whole = weights @ mean
    apart = mean - whole
    return whole, np.einsum("m,mij->ij", weights, cov) + (apart.T * weights) @ apart


def _without_likelihood(place: Place, codes: Array) -> ModelError:
    return _failed(f"the row at step {place.step} has no likelihood", codes)


def _failed(what: str, codes: Array) -> ModelError:
    failure = Failure.of(int(codes[0]))
    return ModelError(". ".join([f"{what}: {failure.message}", *filter(None, [failure.cure])]))
