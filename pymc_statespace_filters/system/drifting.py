"""`drifting`: a system some of whose parameters are states."""

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ModelError
from .drift import DriftingParameter
from .drift_processes import DriftProcess
from .labels import element_label

if TYPE_CHECKING:
    from .model import StateSpaceModel

_ELEMENT = re.compile(r"(?P<parameter>.+)\[(?P<index>\d+(?:\s*,\s*\d+)*)\]")


def drifting(system: "StateSpaceModel", /, **processes: DriftProcess) -> "StateSpaceModel":
    r"""Let parameters of a system drift in time: the system in which they are states.

    A drifting parameter is a state on the scale of its process, :math:`z = \ell(\beta)`, which
    moves once at the end of each step, outside substeps. Its name is that of the parameter, and its
    value at the start is the parameter: priors keep their meaning. States, plots and forecasts
    report it in the units of the parameter. The drift has its own parameters:

    * ``beta_strength``, of both processes: the standard deviation of z per square root of time;
    * ``beta_rate``, of `OrnsteinUhlenbeck`: the rate at which z returns to its start.

    With a strength of zero the system is the one without drift. Use half-normal priors for
    strengths, scaled by what is plausible: on the scale "log" a strength of 0.1 is a change of
    about 10 % in one unit of time.

    Parameters
    ----------
    system : StateSpaceModel
    **processes : RandomWalk or OrnsteinUhlenbeck
        One for each drifting parameter, by its name. All elements of an array of parameters drift,
        each with its own strength: ``b_strength`` has the shape of ``b``. One element is given
        as ``**{"b[2]": psf.RandomWalk()}``, with the parameter ``b[2]_strength``.

    Returns
    -------
    StateSpaceModel
        States and noises of the drift are behind those of the system, in the order given.

    Raises
    ------
    ModelError
        If a name is not that of a parameter of the equations; if a parameter drifts already; if its
        default is outside its scale; if it enters the covariance of a noise; or if the system was
        unpickled.

    Notes
    -----
    The sigma points of `UKF` and `IPLF` depend on the number of states, so that with a strength of
    zero their approximation of a nonlinear system may differ from that without drift.

    A particle is a path of the parameters too; a Gaussian filter has a mean and a covariance
    of them on their scales. Moments that are reported in a parameter's units assume a normal
    distribution on its scale, which is exact for Gaussian filters; draws are exact for all.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> decay = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(lambda x, k: [-k * x[0]], [[0.1]], dt=0.1),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[1.0],
    ...     initial_cov=[[0.0]],
    ... )
    >>> moving = psf.drifting(decay, k=psf.RandomWalk(scale="log"))
    >>> moving.states, moving.parameters
    (('x0', 'k'), ('k', 'k_strength'))
    >>> record = psf.simulate(moving, {"k": 0.5, "k_strength": 0.3}, steps=[10, 20], random_seed=1)
    >>> bool((record["states"].sel(state="k") > 0).all())
    True
    """
    from .record import check_system

    check_system(system)
    if not processes:
        raise ModelError(
            "give a process for at least one parameter, such as beta=psf.RandomWalk(); the "
            f"parameters are {list(system.parameters)}"
        )
    found = list(system.drifting)
    for key, process in processes.items():
        found += _drifting_parameters(system, key, process)
    _check_names(system, found)
    return system.with_drifting(found)


def _drifting_parameters(
    system: "StateSpaceModel", key: str, process: Any
) -> list[DriftingParameter]:
    """The states of one drifting parameter, by its name or that of an element."""
    if isinstance(process, type) and issubclass(process, DriftProcess):
        raise ModelError(f"{key} must be a process, got a class: write psf.{process.__name__}()")
    if not isinstance(process, DriftProcess):
        raise ModelError(
            f"{key} must be psf.RandomWalk(...) or psf.OrnsteinUhlenbeck(...), got {process!r}"
        )
    shapes = dict(zip(system.parameters, system.parameter_shapes, strict=True))
    parameter, index = _place(key, shapes)
    laws = tuple(f"{key}_{name}" for name in process.parameters)
    indices = [index] if index else list(np.ndindex(shapes[parameter]))
    states = [
        DriftingParameter(
            element_label(parameter, each), parameter, each, process, laws, () if index else each
        )
        for each in indices
    ]
    defaults = dict(system.defaults)
    for state in states:
        if parameter not in defaults:
            continue
        value = float(np.asarray(defaults[parameter])[state.index])
        if not state.link.contains(value):
            raise ModelError(
                f"{state.name} must start on the scale {process.scale!r}, got its default {value:g}"
            )
    return states


def _place(key: str, shapes: Mapping[str, tuple[int, ...]]) -> tuple[str, tuple[int, ...]]:
    """A parameter and the index of an element of it, () for the whole."""
    if key in shapes:
        return key, ()
    element = _ELEMENT.fullmatch(key)
    if element and element["parameter"] in shapes:
        parameter, index = element["parameter"], tuple(map(int, element["index"].split(",")))
        shape = shapes[parameter]
        if len(index) == len(shape) and all(i < n for i, n in zip(index, shape, strict=True)):
            return parameter, index
        raise ModelError(f"{key} must be an element of {parameter}, which has the shape {shape}")
    raise ModelError(
        f"{key} must be a parameter of the system, or an element of one such as b[2], got a system "
        f"with the parameters {list(shapes)}"
    )


def _check_names(system: "StateSpaceModel", found: list[DriftingParameter]) -> None:
    """Raise unless every state has a name of its own, and a parameter that equations have."""
    of_law = {name for one in found for name in one.laws}
    taken, drifts = set(system.states[: system.n - len(system.drifting)]), set[str]()
    for one in found:
        if one.parameter in of_law:
            raise ModelError(f"{one.name} must not drift: it is a parameter of another drift")
        if one.name in drifts:
            raise ModelError(f"{one.name} drifts already: give the process of each parameter once")
        if one.name in taken:
            raise ModelError(f"{one.name} must not be the name of a state: rename the state")
        drifts.add(one.name)
    law_names = [name for one in found[len(system.drifting) :] for name in dict.fromkeys(one.laws)]
    for name in law_names:
        if name in system.parameters:
            raise ModelError(f"{name} must not be a parameter of the system: rename it there")
    system.check_drifting([one.parameter for one in found])
