"""Statistical linear regression of a function of a Gaussian state by sigma points.

A function y(x) with noise is replaced by the line through its mean that has the least mean square
error over the state, and by a Gaussian noise with the covariance of what remains,

    y ~ mean + jac xi + N(0, noise_cov),    x = m + L xi,   xi ~ N(0, I),   P = L L'.

The expectations are sums over the sigma points m and m +- c l_i, l_i the columns of L, with the
weights 1 - n / c^2 and 1 / (2 c^2). In differences of pairs of points,

    jac_i = (y_i+ - y_i-) / (2 c),    bend_i = (y_i+ + y_i-) / 2 - y_0,

the covariance of y is jac jac' plus a sum over the bends, so that a linear function leaves no noise
of its own, without cancellation, and a singular P needs no inverse. Noise of the function enters by
the mean of its covariance given x.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import vectorize_graph
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.semidefinite import semidefinite_root
from ...compiler.lowering.symbols import symbols_of, transition_moments
from ...errors import ModelError
from ...system.model import StateSpaceModel
from .linearization import GaussianState, Linear, Symbols

AtPoints = Callable[[TensorVariable], list[TensorVariable]]

MAX_ROWS = 13  # of six states


def check_kappa(kappa: float | None, n: int) -> None:
    """Raise if the sigma points of n states coincide."""
    if kappa is not None and n + kappa <= 0:
        raise ModelError(f"kappa must be above {-n} for {n} states, got {kappa!r}")


@dataclass(frozen=True)
class SigmaPoints:
    """The scaled unscented transform (Julier 2002); ``kappa`` None is max(3 - n, 0)."""

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float | None = None

    has_short_rows: ClassVar[bool] = False

    def squared_distance(self, n: int) -> float:
        """c^2 for n states: the points are c standard deviations from the mean."""
        kappa = max(3.0 - n, 0.0) if self.kappa is None else self.kappa
        return self.alpha**2 * (n + kappa)

    def points(self, centre: TensorVariable, root: TensorVariable) -> TensorVariable:
        """Rows centre, centre + c l_i, centre - c l_i of a matrix (2 n + 1, n)."""
        steps = np.sqrt(self.squared_distance(centre.type.shape[0])) * root.T
        return pt.concatenate([centre[None, :], centre[None, :] + steps, centre[None, :] - steps])

    def regress(self, moments: AtPoints, centre: TensorVariable, root: TensorVariable) -> Linear:
        """The line for y over N(centre, root root'); ``moments`` are those of y given x."""
        n = centre.type.shape[0]
        square = self.squared_distance(n)
        y, cov = moments(self.points(centre, root))
        plus, minus = y[1 : n + 1] - y[0], y[n + 1 :] - y[0]
        bend = (0.5 * (plus + minus)).T
        shift = pt.sum(bend, axis=1) / square
        spread = bend - shift[:, None]
        of_centre = 2.0 - n / square - self.alpha**2 + self.beta
        remainder = spread @ spread.T / square + of_centre * pt.outer(shift, shift)
        mean_cov = cov[0] + pt.sum(cov[1:] - cov[0], axis=0) / (2.0 * square)
        jac = ((y[1 : n + 1] - y[n + 1 :]) / (2.0 * np.sqrt(square))).T
        return Linear(y[0] + shift, jac, mean_cov + remainder)

    def state(self, mean: TensorVariable, cov: TensorVariable) -> GaussianState:
        """The state by a root of its covariance, which may be singular."""
        return GaussianState(mean, semidefinite_root(cov), None)

    def transition(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Linear:
        """The next state."""
        moments = at_points(transition_moments, system, values)
        return self.regress(moments, state.mean, state.root)


def at_points(
    of: Callable, system: StateSpaceModel, values: Symbols, names: Sequence[str] = ("u", "t")
) -> AtPoints:
    """What ``of(system, symbols)`` returns as a function of rows x; it is called once.

    A few rows are written one after the other, which leaves scalar code everything that it can
    simplify. Many would be too much to compile, and are evaluated as one array.
    """
    symbols = {name: symbols_of(system)[name] for name in ("x", "theta", *names)}
    traced = FrozenFunctionGraph.from_io(list(symbols.values()), list(of(system, symbols)))
    others = [values[name] for name in list(symbols)[1:]]

    def outputs(X: TensorVariable) -> list[TensorVariable]:
        n_rows = X.type.shape[0]
        if n_rows <= MAX_ROWS:
            rows = [traced.bind([X[i], *others]) for i in range(n_rows)]
            return [pt.stack(column) for column in zip(*rows, strict=True)]
        x = symbols["x"].type("x")
        found = traced.bind([x, *others])
        stacked = vectorize_graph(found, {x: X})
        return [
            # What does not depend on x has no rows yet.
            pt.specify_shape(rows + pt.zeros((n_rows, *one.type.shape)), (n_rows, *one.type.shape))
            for one, rows in zip(found, stacked, strict=True)
        ]

    return outputs
