r"""The evidence of a constant model over that of the drifting one, from draws of the latter.

With strengths s, all other parameters r and any proper density w,

.. math::

    \frac{Z_0}{Z_1} = E\left[\frac{w(s | r)\, p_0(r)\, L(0, r)}{p(s, r)\, L(s, r)}\right],

where the mean is over the posterior of the drifting model and :math:`p_0` is the prior of the
constant one. This is the importance-weighted marginal density estimate of p(0 | D) over p(0)
(Chen 1994), and holds whatever the prior density at zero is. The terms vary least if w is the
posterior density of s given r.

It holds with unbiased estimates of the likelihood, too: the denominator is the estimate by which
the chain accepted the draw. If a noise seed reproduces it, the numerator has the same noise, as the
noise of a posterior draw has the density m(v) L(s, r, v) / L(s, r); otherwise it has fresh noise.

Difference from the source: the terms are taken at r' = r + b(0) - b(s) in place of r in the
numerator, where b(s) is a regression of the draws of r on s. For each s that is a translation, on
which the integral over r does not depend if r is on the whole line; r' is nearer to where the
constant model has its posterior. Other variables, bounded and without a transform, stay.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.distributions.transforms import _default_transform
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.compilation import warning_filter
from ...pymc_model.density import ModelDensity
from ...pymc_model.elements import places_in_vector
from ..posterior import Posterior
from .conditional import ConditionalStrength, fit_conditional
from .strengths import Strengths, StrengthsAtPoints

MOST_SQUARES = 9.0  # mean squares of a strength, beyond which the others are not translated further

Array = NDArray[np.float64]


class ConstantModel:
    """The model with some strengths at zero, as ``pm.do`` makes it.

    ``density`` is that of its other parameters.
    """

    def __init__(self, model: pm.Model, names: Sequence[str], *, moved: bool) -> None:
        self.names = tuple(names)
        shapes = model.eval_rv_shapes()
        zeros = {name: np.zeros(tuple(map(int, shapes[name]))) for name in names}
        constant = pm.do(model, zeros)
        # A prior of the strengths' own parameters reaches no data now.
        with warning_filter("ignore", "the prior of .* reaches no likelihood"):
            self.density = ModelDensity(constant, moved=moved)
        self._strengths = StrengthsAtPoints(model, names)
        others = [rv.name for rv in constant.free_RVs]
        self._others = _columns(model, others)
        bounded = [name for name in others if _is_bounded(model[name], model)]
        self._is_bounded = np.isin(self._others, _columns(model, bounded))

    def log_terms(
        self, posterior: Posterior, seeds: NDArray[np.int64] | None, rng: np.random.Generator
    ) -> Array:
        """Logs of the averaged terms, (chain, draw); w and b are those of the other half chains.

        ``seeds`` (chain, draw, n_seeds) are those of the estimates of the draws, if known.
        """
        log_terms = np.empty(posterior.log_density.shape)
        middle = log_terms.shape[1] // 2
        halves = slice(None, middle), slice(middle, None)
        for fitted, averaged in (halves, halves[::-1]):
            x, at = (_flat(posterior.draws[:, part]) for part in (fitted, averaged))
            fit = fit_conditionals(self._strengths(x), x[:, self._others], self._is_bounded)
            strengths, others = self._strengths(at), at[:, self._others]
            others = fit.translated(strengths.sizes, others)
            if seeds is None:
                own = self.density.fresh_seeds(len(at), rng)
            else:
                own = _flat(seeds[:, averaged])
            found = fit.log_density(strengths, others) + self.density.evaluate(others, own)
            found -= posterior.log_density[:, averaged].ravel()
            log_terms[:, averaged] = found.reshape(log_terms[:, averaged].shape)
        return log_terms


@dataclass(frozen=True)
class FittedConditionals:
    """The density w of several strengths given the other parameters, one after the other.

    ``translation`` (2 d, k) are the coefficients of b, ``scale`` (d,) roots of the mean squares.
    """

    conditionals: tuple[ConditionalStrength, ...]
    translation: Array
    scale: Array

    def translated(self, sizes: Array, others: Array) -> Array:
        """The other parameters (n, k) at strengths (n, d), moved to where they are at zero."""
        return np.asarray(others - _powers(sizes, self.scale) @ self.translation)

    def log_density(self, strengths: Strengths, others: Array) -> Array:
        """Log of w by the unconstrained strengths, (n,)."""
        given = _regressors(strengths.sizes, others)
        sizes = strengths.sizes.T
        each = [
            one.log_density(s, regressors)
            for one, s, regressors in zip(self.conditionals, sizes, given, strict=True)
        ]
        halved = strengths.is_signed.sum() * np.log(2)
        return np.asarray(np.sum(each, axis=0) - halved + strengths.log_jacobian)


def fit_conditionals(
    strengths: Strengths, others: Array, stays: NDArray[np.bool_]
) -> FittedConditionals:
    """Fit to draws of strengths (n, d) and other parameters (n, k), some of which stay (k,)."""
    sizes = strengths.sizes
    scale = np.sqrt((sizes**2).mean(axis=0))
    powers = _powers(sizes, scale)
    design = np.column_stack([np.ones(len(powers)), powers])
    translation = np.where(stays, 0.0, np.linalg.lstsq(design, others, rcond=None)[0][1:])
    given = _regressors(sizes, others - powers @ translation)
    fitted = map(fit_conditional, sizes.T, given, strengths.largest)
    return FittedConditionals(tuple(fitted), translation, scale)


def _powers(sizes: Array, scale: Array) -> Array:
    """The regressors (n, 2 d) of b; zero at zero."""
    square = np.minimum((sizes / scale) ** 2, MOST_SQUARES)
    return np.column_stack([np.sqrt(square), square])


def _regressors(sizes: Array, others: Array) -> Iterator[Array]:
    """What each strength is given: the other parameters and the strengths before it."""
    for i in range(sizes.shape[1]):
        yield np.column_stack([others, sizes[:, :i]])


def _flat(values: NDArray) -> NDArray:
    n_chains, n_draws, n = values.shape
    return values.reshape(n_chains * n_draws, n)


def _is_bounded(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether the values of a free variable, without a transform, are not the whole line."""
    if model.rvs_to_transforms[rv] is not None:
        return False
    default = _default_transform(rv.owner.op, rv)
    return default is not None


def _columns(model: pm.Model, names: Sequence[str]) -> NDArray[np.int64]:
    """Columns of the unconstrained vector that belong to free variables, in the order of names."""
    places = places_in_vector(model)
    columns = [places[name].ravel() for name in names]
    return np.concatenate([np.empty(0, dtype=np.int64), *columns])
