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

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.semidefinite import semidefinite_root
from pymc_statespace_filters.compiler.lowering.symbols import symbols_of, transition_moments
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.gaussian.linearization import GaussianState, Linear, Symbols
from pymc_statespace_filters.system.model import StateSpaceModel

Moments = Callable[[TensorVariable], tuple[TensorVariable, TensorVariable]]


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

    def regress(self, moments: Moments, centre: TensorVariable, root: TensorVariable) -> Linear:
        """The line for y over N(centre, root root'); ``moments`` are those of y given x."""
        n = centre.type.shape[0]
        square = self.squared_distance(n)
        y, cov = moments(centre)
        slopes, bends, mean_cov = [], [], cov
        for i in range(n):
            step = np.sqrt(square) * root[:, i]
            (plus, plus_cov), (minus, minus_cov) = moments(centre + step), moments(centre - step)
            slopes.append((plus - minus) / (2.0 * np.sqrt(square)))
            bends.append(0.5 * ((plus - y) + (minus - y)))
            mean_cov += ((plus_cov - cov) + (minus_cov - cov)) / (2.0 * square)
        bend = pt.stack(bends, axis=1)
        shift = pt.sum(bend, axis=1) / square
        spread = bend - shift[:, None]
        of_centre = 2.0 - n / square - self.alpha**2 + self.beta
        remainder = spread @ spread.T / square + of_centre * pt.outer(shift, shift)
        return Linear(y + shift, pt.stack(slopes, axis=1), mean_cov + remainder)

    def state(self, mean: TensorVariable, cov: TensorVariable) -> GaussianState:
        """The state by a root of its covariance, which may be singular."""
        return GaussianState(mean, semidefinite_root(cov), None)

    def transition(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Linear:
        """The next state."""
        moments = at_points(transition_moments, system, values)
        return self.regress(moments, state.mean, state.root)


def at_points(of: Callable, system: StateSpaceModel, values: Symbols) -> Moments:
    """Mean and covariance of an equation as a function of x, traced once."""
    names = ("theta", "x", "u", "t")
    symbols = {name: symbols_of(system)[name] for name in names}
    graph = FrozenFunctionGraph.from_io(list(symbols.values()), list(of(system, symbols)))

    def moments(x: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
        mean, cov = graph.bind([x if name == "x" else values[name] for name in names])
        return mean, cov

    return moments
