"""Data from a state-space system as a PyMC random variable."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.distributions.distribution import Continuous
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evaluation.log_likelihood import check_kinds
from pymc_statespace_filters.filters.protocol import Filter
from pymc_statespace_filters.pymc_model.random_variable import StateSpaceRV
from pymc_statespace_filters.system.model import StateSpaceModel
from pymc_statespace_filters.system.parameters import (
    check_names,
    missing_parameters,
    parameter_numbers,
)
from pymc_statespace_filters.system.record import (
    check_inputs,
    check_observed,
    check_seed,
    check_t0,
    steps_of,
)


class StateSpace(Continuous):
    r"""A record of a state-space system, as a random variable of shape (J, p).

    Its log-density is the log-likelihood by a filter, one term log p(d_j | d_1 .. d_{j-1}) per
    observation; its draws are forward simulations. The terms are sequential: PSIS-LOO on them is
    not leave-one-out.

    Parameters
    ----------
    name : str
        Name of the variable.
    system : StateSpaceModel
        The equations.
    filter : EKF, EnKF, BootstrapPF, PFEnKF or GridFilter
        How the likelihood is computed.
    params : mapping, optional
        Parameters by name, numbers or expressions. A parameter not named here is the variable of
        that name in the PyMC model, else the default in the function's signature.
    steps, times : array_like, shape (J,)
        When observations were taken; give one of them. See `log_likelihood`.
    observed : array_like, shape (J, p) or (J,), optional
        The data. NaN means missing and is never imputed; a wholly missing row has the term 0.
        To exchange data later give `steps`, `observed` and `inputs` as ``pm.Data``, with
        ``dims=("{name}_time", "observable")``; ``pm.Data`` holds no NaN, ``pytensor.shared`` does.
    inputs : array_like, shape (rows, n_inputs), optional
        Row k holds during step k.
    t0 : float
        Time of step 0.
    seed : int
        The noise inside the filter, held by the model as data of the name ``{name}_seed``;
        sampling does not change it.
    dims : (str, str), optional
        Names of the dimensions, ``({name}_time, observable)`` if not given.

    Raises
    ------
    ModelError
        If data, steps, inputs and system disagree, or a parameter has no value.

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
        observed: Any = None,
        inputs: Any = None,
        t0: float = 0.0,
        seed: int = 0,
        dims: Sequence[str] | None = None,
    ) -> TensorVariable:
        """Add the variable, its coordinates and its seed to the model of the context."""
        model = pm.modelcontext(None)
        check_kinds(system, filter)
        t0 = check_t0(t0)
        theta = _theta(system, {} if params is None else params, model)
        symbolic_steps, at = _steps(steps, times, system.dt, t0)
        data = _observed(observed, system, at)
        forces = _inputs(inputs, system, at)
        seed_array = check_seed("seed", seed)
        if seed_array.ndim:
            raise ModelError(f"seed must be one integer, got an array of shape {seed_array.shape}")
        full_name = model.name_for(name)
        time_dim, component_dim = _dims(full_name, dims)
        _add_coord(model, time_dim, t0 + at * system.dt, name)
        _add_coord(model, component_dim, list(system.observables), name)
        noise_seed = _add_seed(model, full_name, seed_array) if filter.noisy else seed_array
        return super().__new__(
            cls,
            name,
            theta,
            symbolic_steps,
            forces,
            t0,
            noise_seed,
            system=system,
            filter=filter,
            observed=data,
            dims=(time_dim, component_dim),
        )

    @classmethod
    def dist(cls, *params: Any, system: StateSpaceModel, filter: Filter, **kwargs: Any) -> Any:
        """The variable outside a model; parameters are theta, steps, inputs, t0 and seed."""
        dtypes = ("float64", "int64", "float64", "float64", "int64")
        symbols = [
            pt.cast(p, dtype) if isinstance(p, Variable) else pt.as_tensor(np.asarray(p, dtype))
            for p, dtype in zip(params, dtypes, strict=True)
        ]
        return super().dist(symbols, system=system, filter=filter, **kwargs)

    @classmethod
    def rv_op(
        cls, *params: Any, system: StateSpaceModel, filter: Filter, rng: Any = None, **kwargs: Any
    ) -> TensorVariable:
        """Apply the operation; called by PyMC."""
        rng = pt.random.shared_rng(seed=None) if rng is None else rng
        operation = StateSpaceRV(system=system, filter=filter)
        _, draw = operation(*params, rng=rng, return_next_rng=True, **kwargs)
        return draw

    def support_point(rv: TensorVariable, *params: Any) -> TensorVariable:
        """A finite record to start from, where the record itself is not observed."""
        return pt.zeros_like(rv)


def _theta(system: StateSpaceModel, params: Mapping[str, Any], model: pm.Model) -> TensorVariable:
    check_names(system, params)
    found = dict(system.defaults) | _model_variables(system, model) | dict(params)
    if any(name not in found for name in system.parameters):
        raise missing_parameters(system, found)
    parts = []
    for name, shape in zip(system.parameters, system.parameter_shapes, strict=True):
        value = found[name]
        symbol = (
            value if isinstance(value, Variable) else pt.as_tensor(parameter_numbers(name, value))
        )
        same = symbol.type.ndim == len(shape) and all(
            s is None or s == e for s, e in zip(symbol.type.shape, shape, strict=False)
        )
        if not same:
            raise ModelError(
                f"parameter {name!r} must have shape {shape}, got {symbol.type.shape}"
                f"{'' if shape else ' (declare shapes={...} in the system for an array)'}"
            )
        parts.append(pt.cast(symbol, "float64").ravel())
    theta = pt.concatenate(parts) if parts else pt.as_tensor(np.zeros(0))
    return pt.specify_shape(theta, (system.n_theta,))


def _model_variables(system: StateSpaceModel, model: pm.Model) -> dict[str, Variable]:
    """Parameters that the model names; what a submodel lacks, the model around it may have."""
    enclosing = _model_variables(system, model.parent) if model.parent is not None else {}
    names = {name: model.name_for(name) for name in system.parameters}
    return enclosing | {
        name: model.named_vars[full] for name, full in names.items() if full in model.named_vars
    }


def _steps(steps: Any, times: Any, dt: float, t0: float) -> tuple[Any, np.ndarray]:
    """The steps as given to the graph, and their present numbers."""
    if isinstance(times, Variable):
        raise ModelError("times cannot be symbolic; give steps=pm.Data(...) of step numbers")
    if isinstance(steps, Variable):
        if times is not None:
            raise ModelError("give exactly one of steps and times")
        return steps, steps_of(steps.eval(), None, dt, t0)
    numbers = steps_of(steps, times, dt, t0)
    return numbers, numbers


def _observed(observed: Any, system: StateSpaceModel, steps: np.ndarray) -> Any:
    """Data as a symbol: PyMC would mask and impute the NaN of an array."""
    if observed is None:
        return None
    if isinstance(observed, Variable):
        if observed.type.ndim != 2:
            raise ModelError(
                f"symbolic observed must have 2 dimensions (observations, observables), "
                f"got {observed.type.ndim}"
            )
        if isinstance(observed, SharedVariable):
            check_observed(observed.get_value(), system, steps.size)
        return observed
    return pt.as_tensor(check_observed(observed, system, steps.size))


def _inputs(inputs: Any, system: StateSpaceModel, steps: np.ndarray) -> Any:
    """Inputs as numbers, or as a symbol of two dimensions: data, or an expression of parameters."""
    if not isinstance(inputs, Variable):
        return check_inputs(inputs, system, steps)
    if isinstance(inputs, SharedVariable):
        check_inputs(inputs.get_value(), system, steps)
    if inputs.type.ndim == 1 and system.n_inputs == 1:
        inputs = inputs[:, None]
    if not system.n_inputs or inputs.type.ndim != 2:
        raise ModelError(
            f"inputs must have shape (steps, {system.n_inputs}), a column for each of "
            f"{list(system.inputs)}, got {inputs.type}"
        )
    return inputs


def _dims(name: str, dims: Sequence[str] | None) -> tuple[str, str]:
    if dims is None:
        return f"{name}_time", "observable"
    if isinstance(dims, str) or len(dims) != 2 or not all(isinstance(d, str) for d in dims):
        raise ModelError(f"dims must be two names, (time, observable), got {dims!r}")
    time_dim, component_dim = dims
    return time_dim, component_dim


def _add_seed(model: pm.Model, name: str, seed: np.ndarray) -> SharedVariable:
    # What pm.Data does, which would cut the seed to 32 bits.
    shared = pytensor.shared(seed, name=f"{name}_seed")
    model.register_data_var(shared)
    return shared


def _add_coord(model: pm.Model, dim: str, values: Any, name: str) -> None:
    if dim not in model.coords:
        model.add_coord(dim, values)
        return
    known = model.coords[dim]  # None for a dimension that the user made without coordinates
    length = model.dim_lengths[dim].eval() if known is None else len(known)
    if length != len(values) or (known is not None and list(known) != list(values)):
        raise ModelError(
            f"the model has a dimension {dim!r} of length {length} with other coordinates; "
            f"give {name!r} its own names with dims=(..., ...)"
        )
