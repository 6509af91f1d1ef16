"""Errors of measurements that grow with what is measured, as arguments of a system."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .equations import RESERVED, as_vector

Values = dict[str, TensorVariable]


def normal_error(
    prediction: Callable,
    *,
    additive: str | Sequence[str | None] | None = None,
    proportional: str | Sequence[str | None] | None = None,
) -> dict[str, Any]:
    r"""Normal errors of constant size, in proportion to the prediction, or the sum of both.

    .. math::
        d = f + a\,e_1 + b\,f\,e_2, \qquad e_1, e_2 \sim N(0, 1), \qquad
        \operatorname{var}(d \mid f) = a^2 + b^2 f^2

    Parameters
    ----------
    prediction : callable
        ``f(x, u, t, ...)`` returning what would be measured without error, an expression for each
        observable.
    additive, proportional : str or sequence of str, optional
        Names of the parameters a, in the unit of the data, and b, a fraction; of several
        observables a list, with None for an observable without it.

    Returns
    -------
    dict
        ``observation`` and ``observation_noise`` of `StateSpaceModel`, for any filter that takes
        Gaussian noise.

    Raises
    ------
    ModelError
        If an observable has no error, or a name is not that of a parameter.

    Notes
    -----
    The density is exact given the state. Gaussian filters take b f at the predicted mean of the
    state: with process noise, an approximation, see `check_filter`. A proportional error alone is
    zero where the prediction is, as before a first dose, and the likelihood of such a row is none.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.ExactLinear(lambda CL, V: [[-CL / V]], [[0.0]], dt=1.0),
    ...     initial_mean=[100.0],
    ...     initial_cov=[[0.0]],
    ...     **psf.pharmacometrics.normal_error(
    ...         lambda x, V: [x[0] / V], additive="sd_add", proportional="sd_prop"
    ...     ),
    ... )
    >>> system.parameters
    ('CL', 'V', 'sd_add', 'sd_prop')
    """
    given = {"additive": additive, "proportional": proportional}
    names = {kind: _names(kind, own) for kind, own in given.items() if own is not None}
    n = len(next(iter(names.values()), ()))
    both = [names.get(kind, [None] * n) for kind in given]
    if not n or len(both[0]) != len(both[1]) or (None, None) in zip(*both, strict=True):
        raise ModelError(
            "additive and proportional must name an error for each observable, in lists of one "
            f"length where there are several, got {additive!r} and {proportional!r}"
        )
    used = [name for own in both for name in own if name is not None]
    if "proportional" not in names:
        noise = _with_arguments(lambda **sd: pt.diag(pt.stack([sd[a] ** 2 for a in used])), used)
        return {"observation": prediction, "observation_noise": noise}

    def with_errors(seen: list[TensorVariable], values: Values) -> list[Any]:
        e, pairs = values["e"], zip(seen, *both, strict=True)
        sizes = [_sd(f, values.get(a), values.get(b)) for f, a, b in pairs]
        return [f + size * e[i] for i, (f, size) in enumerate(zip(seen, sizes, strict=True))]

    observation = _of_prediction(prediction, n, with_errors, ["e", *used])
    return {"observation": observation, "observation_noise": np.eye(n).tolist()}


def log_normal_error(prediction: Callable, sd: str | Sequence[str]) -> dict[str, Any]:
    r"""Errors that multiply the prediction, log-normal with the median f.

    .. math:: \log d \sim N(\log f, s^2)

    Parameters
    ----------
    prediction : callable
        ``f(x, u, t, ...)`` returning what would be measured without error, an expression for each
        observable; positive where there are data.
    sd : str or sequence of str
        Names of the parameters s, of several observables one for each.

    Returns
    -------
    dict
        ``observation_dist`` of `StateSpaceModel`. The density is that of the data, not of their
        logarithms, so that evidences compare with those of `normal_error`.

    Raises
    ------
    ModelError
        If a name is not that of a parameter.

    Notes
    -----
    Particle filters and `IPLF` take it, and `EKF` where the state is known given the parameters.
    Otherwise `EKF` and `UKF` take the logarithms of the data with ``normal_error(lambda x, V:
    [pt.log(x[0] / V)], additive="s")``, whose log-likelihood is larger by the sum of these.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> import pytensor.tensor as pt
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, CL, V: [pt.exp(-CL / V) * x[0]],
    ...     initial_mean=[100.0],
    ...     initial_cov=[[0.0]],
    ...     **psf.pharmacometrics.log_normal_error(lambda x, V: [x[0] / V], "s"),
    ... )
    >>> at = {"CL": 1.0, "V": 10.0, "s": 0.1}
    >>> psf.log_likelihood(system, psf.EKF(), at, [8.0], steps=[1]).round(2)
    array([-1.45])
    """
    names = _names("sd", sd)

    def distributions(seen: list[TensorVariable], values: Values) -> list[TensorVariable]:
        from pymc import LogNormal  # the user has imported it

        pairs = zip(seen, names, strict=True)
        return [LogNormal.dist(mu=pt.log(f), sigma=values[name]) for f, name in pairs]

    return {"observation_dist": _of_prediction(prediction, len(names), distributions, names)}


def _sd(f: TensorVariable, a: TensorVariable | None, b: TensorVariable | None) -> Any:
    if a is None or b is None:
        return a if b is None else b * f
    return pt.sqrt(a**2 + (b * f) ** 2)


def _names(argument: str, given: Any) -> list[Any]:
    """The name of a parameter for each observable; None where it lacks one of two errors."""
    names = [given] if isinstance(given, str) else given
    allowed = (str,) if argument == "sd" else (str, type(None))
    is_list = isinstance(names, list | tuple) and all(isinstance(n, allowed) for n in names)
    if not is_list or any(n in RESERVED for n in names):
        raise ModelError(f"{argument} must name a parameter for each observable, got {given!r}")
    return list(names)


def _of_prediction(
    prediction: Any, n: int, function: Callable, names: Sequence[str]
) -> Callable[..., Any]:
    """``function(seen, values)`` of n predictions, with the arguments of both."""
    if not callable(prediction):
        raise ModelError(f"prediction must be a function, got {prediction!r}")
    own = inspect.signature(prediction).parameters

    def written(**values: TensorVariable) -> Any:
        whole = as_vector("prediction", prediction(**{name: values[name] for name in own}), n)
        return function([whole[i] for i in range(n)], values)

    return _with_arguments(written, names, own)


def _with_arguments(
    function: Callable, names: Sequence[str], own: Mapping[str, inspect.Parameter] | None = None
) -> Callable[..., Any]:
    """The function, with its own arguments and those of these names."""
    kind, known = inspect.Parameter.KEYWORD_ONLY, dict(own or {})
    more = {name: inspect.Parameter(name, kind) for name in names if name not in known}
    function.__signature__ = inspect.Signature([*(known | more).values()])  # type: ignore[attr-defined]
    return function
