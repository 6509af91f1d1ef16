"""The start of a system: mean and covariance of the state at step 0, or its distributions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import jacobian
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .equations import Equation, as_vector, read_equation
from .graph_digest import freeze
from .random_variables import GivenValues, trace_distributions

Values = Mapping[str, TensorVariable]


@dataclass(frozen=True)
class Start:
    """The state at step 0: mean, covariance, and unless it is Gaussian a draw from ``normals``."""

    mean: TensorVariable
    cov: Any
    normals: TensorVariable | None = None
    draw: TensorVariable | None = None
    given: GivenValues | None = None

    def freeze_draw(self, theta: TensorVariable) -> FrozenFunctionGraph | None:
        """The graph of a draw; None for a Gaussian start."""
        if self.draw is None or self.normals is None:
            return None
        return freeze([theta, self.normals], [self.draw], "initial_dist")

    def freeze_given_values(self, theta: TensorVariable) -> FrozenFunctionGraph | None:
        """The graph of the state given the values of finite variables, and of their law."""
        if self.given is None or self.normals is None:
            return None
        both = pt.concatenate([self.given.entries, self.given.law])
        return freeze([theta, self.normals, self.given.values], [both], "initial_dist")


def check_start(mean: Any, cov: Any, dist: Any) -> None:
    """Raise unless the start is given in one of its two forms."""
    given = [
        name for name, value in (("initial_mean", mean), ("initial_cov", cov)) if value is not None
    ]
    if dist is not None and given:
        raise ModelError(
            f"initial_dist must be given without {' and '.join(given)}, got both: the state at "
            "step 0 has one law"
        )
    if dist is None and len(given) < 2:
        raise ModelError(
            "give initial_mean and initial_cov, or initial_dist, a function that returns one "
            f"distribution per state; got {given[0] + ' alone' if given else 'none of them'}"
        )


def read_initial_mean(value: Any) -> Any:
    """The initial mean as an `Equation` of parameters alone, or as the numbers given."""
    if callable(value):
        return read_equation("initial_mean", value, "")
    try:
        mean = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"initial_mean must be numbers or a function, got {value!r}") from None
    if mean.ndim > 1 or not np.isfinite(mean).all():
        raise ModelError(
            f"initial_mean must be a finite vector, one entry per state, got {value!r}"
        )
    return np.atleast_1d(mean)


def trace_start(
    initial_mean: Any, initial_dist: Equation | None, values: Values, theta: TensorVariable
) -> Start:
    """The state at step 0, whose covariance is None as long as its size is not known."""
    if initial_dist is None:
        mean = initial_mean(values) if isinstance(initial_mean, Equation) else initial_mean
        m0 = as_vector("initial_mean", mean)
        if m0.type.shape[0] == 0:
            raise ModelError("initial_mean must have an entry for at least one state, got none")
        return Start(m0, None)
    drawn = trace_distributions(initial_dist, values, theta, "z")
    n, m = drawn.exact.type.shape[0], drawn.normals.type.shape[0]
    mean, cov = drawn.surrogate, pt.zeros((n, n))
    if m:
        jac = pt.specify_shape(
            jacobian(mean, drawn.normals, vectorize=True, disconnected_inputs="ignore"), (n, m)
        )
        mean, cov = graph_replace([mean, jac @ jac.T], {drawn.normals: pt.zeros((m,))})
    if drawn.is_gaussian:
        return Start(mean, cov)
    return Start(mean, cov, drawn.normals, drawn.where_valid(drawn.exact), drawn.given)
