"""`StateSpace`: data from a state-space system as a PyMC random variable."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.distributions.distribution import Continuous
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..errors import ModelError
from ..evaluation.exact_rows import check_rows
from ..facts import in_words
from ..filters.checks import Refusal, check_choice
from ..filters.protocol import Filter, properties
from ..filters.written import short_form
from ..system.censoring import read_flags
from ..system.checks import is_integer
from ..system.clock import Clock
from ..system.events import Events
from ..system.given_record import GivenRecord
from ..system.model import StateSpaceModel
from ..system.parameters import (
    check_names,
    known_elements,
    symbolic_panel_parameters,
    symbolic_parameters,
)
from ..system.record import Record, check_seed, check_system, read_record
from ..system.timed_inputs import TimedInputs
from . import dispatch as dispatch  # registers draw and density
from .random_variable import NUMBERS, PanelRV, StateSpaceRV, make_seed
from .record_dimensions import in_order_of_records
from .unused_priors import warn_of_no_data


class StateSpace(Continuous):
    r"""Observations of a state-space system, a random variable of shape (J, p).

    Its log-density is the log-likelihood that a filter computes, one term
    log p(d_j | d_1 .. d_{j-1}) per observation; its draws are forward simulations. The terms are
    sequential: PSIS-LOO on them is not leave-one-out.

    Parameters
    ----------
    name : str
        Name of the variable.
    system : StateSpaceModel
        The equations.
    filter : a filter of the package, such as EKF, GuidedPF, IMM or FiniteStateFilter
        The filter that computes the likelihood.
    params : mapping, optional
        Parameters by name, numbers or expressions. A parameter not named here is the variable of
        that name in the PyMC model, else the default in the function's signature.
    steps : array_like of int, shape (J,)
        Steps of the observations; the initial state holds at step 0. Give `steps` or `times`.
    times : array_like, shape (J,)
        Times of the observations, increasing: numbers, or dates (datetime64, an index of pandas or
        xarray; with a time zone, in UTC). The index of ``observed`` if it holds dates. Off the grid
        ``t0 + k * dt`` (by more than a millionth of a step) an integrator divides each gap into the
        fewest equal steps of at most ``dt``; a transition that is a function has whole steps only.
    panel : array_like of int or str, shape (J,), optional
        For many records of one system: the label of the record of each row. The rows of a record
        are together, its steps increase, and it starts at step 0 and ``t0``. Parameters are then
        scalars, which all G records share, or have a leading dimension G, in the order of the
        records' rows (a declared parameter's own shape comes last); a variable of the model whose
        first dimension has the labels as coordinates is aligned with them. See `panel_from`.
    observed : array_like, shape (J, p) or (J,), optional
        The data; columns of a DataFrame or DataArray are aligned with the system's observables by
        name. NaN marks a missing component and is never imputed; a wholly missing row has the
        term 0. To replace the data later, give `steps`, `observed` and `inputs` as ``pm.Data``,
        with ``dims=("{name}_time", "observable")``; ``pm.Data`` refuses NaN, ``pytensor.shared``
        accepts it.
    inputs : array_like, shape (rows, n_inputs), optional
        Row k holds during step k; named columns are aligned. The records of a panel share them, or
        have one such array each: a mapping from labels, or a list in the order of the records.
    t0 : float or date
        Time of step 0. Of dates, a number is the model's time at the first date of each record, so
        that by default a record starts, in the initial state, at its first row; a date is the start
        of all records, at model time 0.
    unit : str or pandas.Timedelta, optional
        The duration of one unit of model time, where times are dates: ``"D"`` if ``dt`` and rates
        count days.
    input_times : array_like, shape (rows,), optional
        Times of the rows of ``inputs``, numbers or dates, if they have their own; of a panel, as
        ``inputs``, one array for all records or one for each. The index of ``inputs`` if it holds
        dates and the record has times.
    inputs_at : {"hold", "linear"}
        What inputs with times of their own are between these: the last value, or linear, of which a
        step takes the value in its middle, or at its beginning if the observation, its noise
        included, has the argument u. A held value that changes within a step ends the step there.
    events : DataFrame or mapping of columns, optional
        The events of a system that has some, a row for each: the column ``"time"``, numbers or
        dates as `times`, a column for each number that the system's ``event`` takes, and optionally
        ``"before"``. Empty columns are a record without events. An event ends a step, as an input
        that changes does, and acts at the beginning of the next one: an observation at its time
        sees the state before it, and sums start anew before it. Where ``"before"`` is 1 the event
        precedes the observation, by a step of length zero. Events after the last observation are
        those of forecasts. In a panel, one table for all records, or a mapping from labels or list
        of tables.
    censored : array_like, shape (J, p) or (J,), optional
        -1 where the true value lies below the number in ``observed``, 1 where above, 0 elsewhere,
        as for a limit of detection; columns are aligned as those of ``observed``. Of a count, -1
        means at most, and 1 at least the number. Flags stay with their rows where the data are
        replaced. The model stores them for plots alone, as data ``{name}_censored``. See Notes.
    seed : int
        Seed of the noise inside the filter; in a panel, the noise of each record depends on it and
        on the record's label. The model stores it as shared data ``{name}_seed``,
        which sampling does not change.
    score_from : int
        The first row of the data, or of each record, whose term counts, 0 for all. The filter
        passes through the rows before it, which settle a state whose start is not known; their
        terms are 0 in the log-density and in `compute_log_likelihood`, and they do not count as
        observations in the evidence. Models are comparable only with the same number. `GuidedPF`,
        which places its particles for the whole record, takes 0 alone.
    dims : (str, str), optional
        Names of the dimensions, default ``({name}_time, observable)``; of a panel
        ``({name}_obs, observable)``. A panel also adds the dimension ``{name}_record``, whose
        coordinates are the labels, and the data ``{name}_panel`` (the label of each row, or its
        number if labels are texts) and ``{name}_time``.

    Raises
    ------
    ModelError
        If data, steps or inputs do not fit the system, or a parameter has no value.

    Warns
    -----
    FilterWarning
        If the filter linearises an equation that jumps as the state moves, or has members that are
        all the same.

    Notes
    -----
    The likelihood of a censored value is the probability of its side of the limit. In `GridFilter`,
    `FiniteStateFilter`, particle filters and deterministic systems it is the exact probability
    given the state. `EKF`, `UKF` and `IPLF` have the probability of the predicted law, and go on
    with the moments of the truncated law of state and observation (assumed-density filtering),
    which is approximate: where 10 to 70 % of 60 values of a linear system were censored, the error
    had a standard deviation of 0.02 to 0.2 nats over records. Of several components of a row the
    measured ones come first, then the censored ones in the order of columns. `EnKF`,
    ``observation_logp``, ``observation_dist`` in `IPLF`, and sensors whose noise is correlated take
    no censored values. Predictions, simulations and forecasts are of the values behind the limit.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.6]], dt=0.01),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.08]],
    ...     initial_mean=[1.0],
    ...     initial_cov=[[0.5]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.HalfNormal("a", 1)
    ...     d = psf.StateSpace("d", system, psf.EKF(), steps=[0, 20, 40], observed=[1.1, 0.7, 0.9])
    >>> model.named_vars_to_dims["d"]
    ('d_time', 'observable')
    """

    rv_type = StateSpaceRV

    def __new__(
        cls,
        name: str,
        system: StateSpaceModel,
        filter: Filter,
        *,
        params: Mapping[str, Any] | None = None,
        steps: Any = None,
        times: Any = None,
        panel: Any = None,
        observed: Any = None,
        inputs: Any = None,
        t0: Any = 0.0,
        unit: Any = None,
        input_times: Any = None,
        inputs_at: str = "hold",
        events: Any = None,
        censored: Any = None,
        seed: int = 0,
        score_from: int = 0,
        dims: Sequence[str] | None = None,
    ) -> TensorVariable:
        """Add the variable, its coordinates and its seed to the model of the context."""
        model = pm.Model.get_context(error_if_none=False)
        if model is None:
            raise TypeError(
                "No model on context stack: add StateSpace inside a `with model:` block"
            )
        if not isinstance(name, str) or not name:
            raise ModelError(f"name must be a text that is not empty, got {name!r}")
        check_system(system)
        own = {} if params is None else params
        check_names(system, own)
        values = dict(system.defaults) | _model_variables(system, model) | dict(own)
        system = system.with_known(known_elements(system, values))
        check_choice(system, filter)
        others = tuple(model.named_vars)
        full_name = model.name_for(name)
        _check_name(model, full_name, name, system)
        given = GivenRecord(
            observed, panel, steps, times, inputs, t0, unit, input_times, inputs_at, events,
            censored,
        )  # fmt: skip
        record = read_record(system, given, symbolic=True)
        check_rows(record, filter)
        if panel is None:
            theta = symbolic_parameters(system, values, others)
            row_dim, component_dim = _dims(dims, f"{full_name}_time")
            row_coords: Any = record.times([axis.steps for axis in record.axes])
        else:
            values = in_order_of_records(system, values, model, record)
            theta = symbolic_panel_parameters(system, values, record, others)
            row_dim, component_dim = _dims(dims, f"{full_name}_obs")
            row_coords = range(int(record.records.starts[-1]))
        n_rows = int(np.diff(record.records.starts).max())
        seed_array = check_seed("seed", seed)
        if seed_array.ndim:
            raise ModelError(f"seed must be one integer, got an array of shape {seed_array.shape}")
        # A symbol, because PyMC would mask and impute the NaN of an array.
        data = None if record.observed is None else pt.as_tensor(record.observed)
        warn_of_no_data(name, data)
        _add_coord(model, row_dim, row_coords, name)
        _add_coord(model, component_dim, list(system.observables), name)
        if panel is not None:
            _add_records(model, full_name, row_dim, record)
        if record.system.is_censored:
            flags = pytensor.shared(read_flags(censored, system), name=f"{full_name}_censored")
            model.register_data_var(flags, dims=(row_dim, component_dim))
        noise_seed: Any = seed_array
        if filter.noisy:
            noise_seed = make_seed(full_name, seed_array)
            model.register_data_var(noise_seed)
        return super().__new__(
            cls,
            name,
            theta,
            record.steps,
            record.inputs,
            record.t0,
            noise_seed,
            system=record.system,
            filter=filter,
            score_from=_check_score_from(score_from, n_rows, system, filter),
            clock=record.clock,
            timed=record.timed,
            events=record.events,
            observed=data,
            dims=(row_dim, component_dim),
        )

    @classmethod
    def dist(
        cls,
        *params: Any,
        system: StateSpaceModel,
        filter: Filter,
        score_from: int = 0,
        clock: Clock = NUMBERS,
        timed: tuple[TimedInputs, ...] = (),
        events: tuple[Events, ...] = (),
        **kwargs: Any,
    ) -> Any:
        """Make the variable without a model; parameters are theta, steps, inputs, t0 and seed."""
        dtypes = ("float64", "int64", "float64", "float64", "int64")
        symbols = [
            pt.cast(p, dtype) if isinstance(p, Variable) else pt.as_tensor(np.asarray(p, dtype))
            for p, dtype in zip(params, dtypes, strict=True)
        ]
        settings = {
            "system": system, "filter": filter, "score_from": score_from, "clock": clock,
            "timed": timed, "events": events,
        }  # fmt: skip
        return super().dist(symbols, **settings, **kwargs)

    @classmethod
    def rv_op(
        cls,
        *params: Any,
        system: StateSpaceModel,
        filter: Filter,
        score_from: int,
        clock: Clock,
        timed: tuple[TimedInputs, ...],
        events: tuple[Events, ...],
        rng: Any = None,
        **kwargs: Any,
    ) -> TensorVariable:
        """Apply the operation; called by PyMC."""
        rng = pt.random.shared_rng(seed=None) if rng is None else rng
        kind = PanelRV if params[1].type.ndim == 2 else StateSpaceRV
        operation = kind(
            system=system, filter=filter, score_from=score_from, clock=clock, timed=timed,
            events=events,
        )  # fmt: skip
        _, draw = operation(*params, rng=rng, return_next_rng=True, **kwargs)
        return draw

    def support_point(rv: TensorVariable, *params: Any) -> TensorVariable:
        """Finite data as initial value of a variable that is not observed."""
        return pt.zeros_like(rv)


def _model_variables(system: StateSpaceModel, model: pm.Model) -> dict[str, Variable]:
    """The model's variables with names of parameters; a submodel's precede its parent's."""
    enclosing = _model_variables(system, model.parent) if model.parent is not None else {}
    names = {name: model.name_for(name) for name in system.parameters}
    return enclosing | {
        name: model.named_vars[full] for name, full in names.items() if full in model.named_vars
    }


def _check_name(model: pm.Model, full_name: str, name: str, system: StateSpaceModel) -> None:
    """Raise if the variable of a parameter has this name; PyMC says so of any other variable."""
    if name in system.parameters and full_name in model.named_vars:
        raise ModelError(
            f"name must differ from the model's variables, got {name!r}, which is the variable of "
            f"the parameter {name!r} of the system: give the data another name, such as "
            f"'{name}_data'"
        )


def _check_score_from(
    score_from: Any, n_observations: int, system: StateSpaceModel, filter: Filter
) -> int:
    if not is_integer(score_from) or not 0 <= score_from < n_observations:
        raise ModelError(
            f"score_from must be an integer from 0 to {n_observations - 1}, as there are "
            f"{n_observations} observations, got {score_from!r}"
        )
    if score_from and properties(filter).needs_record_ahead:
        raise ModelError(
            f"score_from must be 0 with {short_form(filter)}, which places its particles for the "
            f"whole record and misjudges a part of it, got {score_from}; "
            f"{in_words(Refusal(compile_system(system), filter))}"
        )
    return int(score_from)


def _dims(dims: Sequence[str] | None, of_rows: str) -> tuple[str, str]:
    if dims is None:
        return of_rows, "observable"
    is_pair = isinstance(dims, list | tuple) and len(dims) == 2
    if not is_pair or not all(isinstance(d, str) for d in dims):
        raise ModelError(f"dims must be two names ({of_rows}, observable), got {dims!r}")
    row_dim, component_dim = dims
    return row_dim, component_dim


def _add_records(model: pm.Model, name: str, row_dim: str, panel: Record) -> None:
    """Add the labels of a panel, and the record and time of every row, to the model.

    Rows given as ``pm.Data`` are in the model already, and may change.
    """
    _add_coord(model, f"{name}_record", panel.records.labels, name)
    if isinstance(panel.steps, Variable):
        return
    of_rows = panel.records.of_rows()
    if isinstance(panel.records.labels[0], int):
        of_rows = panel.records.codes[of_rows]
    times = [axis.times(axis.steps) for axis in panel.axes]
    for what, values in (("panel", of_rows), ("time", np.concatenate(times))):
        shared = pytensor.shared(values, name=f"{name}_{what}")
        model.register_data_var(shared, dims=(row_dim,))


def _add_coord(model: pm.Model, dim: str, values: Any, name: str) -> None:
    if dim not in model.coords:
        model.add_coord(dim, values)
        return
    known = model.coords[dim]  # None if the user added the dimension without coordinates
    length = model.dim_lengths[dim].eval() if known is None else len(known)
    if length != len(values) or (known is not None and list(known) != list(values)):
        raise ModelError(
            f"dims of {name!r} must be new, or dimensions with the same coordinates, got {dim!r}, "
            f"a dimension of length {length} with other coordinates; give others as dims=(..., ...)"
        )
