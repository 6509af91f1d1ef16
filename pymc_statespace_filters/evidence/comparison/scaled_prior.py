"""A model's priors made wider or narrower, and what that does to each draw's prior density.

A prior p stretched by the factor w about c is p_w(phi) = p(c + (phi - c) / w) / w. The draws under
p tell its evidence, without new likelihoods:

    Z_w / Z = E[p_w(phi) / p(phi)],   phi from the posterior under p.

The centre c is the end of a support that has one end, or an end at zero, so that a wider prior of a
positive quantity is one of a positive quantity; elsewhere it is PyMC's support point. A prior that
depends on other variables is stretched given them.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import NDArray
from pymc.distributions.distribution import support_point
from pymc.distributions.transforms import _default_transform
from pymc.logprob.transforms import IntervalTransform, LogTransform
from pymc.pytensorf import compile as compile_pymc
from pytensor.graph.replace import clone_replace, vectorize_graph
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.log_mean import (
    MIN_EFFECTIVE,
    SAME,
    log_mean_of_chains,
    pareto_k,
)
from pymc_statespace_filters.evidence.posterior.support import can_sample

EDGE = 0.05  # of the length of a bounded support, at each end
# Past these the draws do not know the evidence under the other priors.
MAX_PARETO_K = 0.5  # from there on the weights have no variance, and their mean no standard error
MAX_BEYOND = 0.02

Array = NDArray[np.float64]


class ReweightedEvidence(NamedTuple):
    """What an evidence becomes under other priors, as far as the draws know.

    Attributes
    ----------
    log_ratio, error : float
        ln Z_w - ln Z and its standard error.
    n_effective : float
        What the draws are worth there, in independent terms of relative variance one.
    pareto_k : float
        Shape of the upper tail of the weights.
    beyond : float
        Upper bound of the share of Z_w that lies where the actual prior is zero.
    """

    log_ratio: float
    error: float
    n_effective: float
    pareto_k: float
    beyond: float

    @property
    def is_reliable(self) -> bool:
        """Whether the draws are enough, and reach far enough."""
        return (
            self.n_effective >= MIN_EFFECTIVE
            and self.pareto_k <= MAX_PARETO_K
            and self.beyond <= MAX_BEYOND
        )


UNCHANGED = ReweightedEvidence(0.0, 0.0, np.inf, -np.inf, 0.0)


class ScaledPrior:
    """The priors of some free variables of a model, to be stretched together.

    Parameters
    ----------
    model : pymc.Model
    names : iterable of str
        The variables.

    Raises
    ------
    ModelError
        If a prior has no width: it is improper, or its support cannot be stretched.
    """

    def __init__(self, model: pm.Model, names: Iterable[str]) -> None:
        stretched = [model[name] for name in names]
        for rv in stretched:
            _check_stretchable(rv, model)
        width = pt.dscalar("width")
        values = {rv: rv.type(name=rv.name) for rv in model.free_RVs}
        sizes = {name: int(np.prod(shape)) for name, shape in model.eval_rv_shapes().items()}
        terms = [_reweighted(rv, values[rv], width, sizes[rv.name]) for rv in stretched]
        outputs = [pt.sum(pt.stack(of_each)) for of_each in zip(*terms, strict=True)]
        rows = {
            value: pt.tensor(value.name, dtype=value.dtype, shape=(None, *value.type.shape))
            for value in values.values()
        }
        self._types = {value.name: value.dtype for value in rows}
        # One call for all draws: not worth machine code.
        self._function = compile_pymc(
            [width, *rows.values()],
            vectorize_graph(clone_replace(outputs, values), rows),
            on_unused_input="ignore",
            mode="FAST_COMPILE",
        )

    def reweighted(self, posterior: xr.Dataset, width: float) -> ReweightedEvidence:
        """Find the evidence under stretched priors.

        Parameters
        ----------
        posterior : xarray.Dataset
            Constrained draws of all free variables.
        width : float
            w.
        """
        shape = posterior.sizes["chain"], posterior.sizes["draw"]
        rows = [
            np.concatenate(posterior[name].transpose("chain", "draw", ...).values).astype(dtype)
            for name, dtype in self._types.items()
        ]
        with np.errstate(all="ignore"):  # a narrow prior may be zero, its logarithm infinite
            log_ratio, beyond = self._function(width, *rows)
        return average_ratios(log_ratio.reshape(shape), np.broadcast_to(beyond, log_ratio.shape))


def average_ratios(log_ratio: Array, beyond: Array) -> ReweightedEvidence:
    """Average the ratios p_w / p of draws (chain, draw), and judge the average.

    Parameters
    ----------
    log_ratio : ndarray (chain, draw)
    beyond : ndarray
        As many; see `_beyond`.
    """
    peak = log_ratio.max()
    if np.isneginf(peak):
        return ReweightedEvidence(-np.inf, np.inf, 0.0, np.inf, 0.0)
    beyond_share = float(np.average(beyond.ravel(), weights=np.exp(log_ratio - peak).ravel()))
    if np.ptp(log_ratio) < SAME:  # a Uniform prior made wider: all draws weigh the same
        return ReweightedEvidence(float(peak), 0.0, np.inf, -np.inf, beyond_share)
    mean = log_mean_of_chains(log_ratio)
    return ReweightedEvidence(
        mean.value, mean.error, mean.n_effective, pareto_k(log_ratio), beyond_share
    )


def _check_stretchable(rv: TensorVariable, model: pm.Model) -> None:
    law = rv.owner.op
    if not can_sample(rv, model):
        raise ModelError(f"the prior of {rv.name!r} is improper and has no width to change")
    support = _default_transform(law, rv)
    if law.ndim_supp > 1 or not isinstance(support, IntervalTransform | LogTransform | None):
        raise ModelError(
            f"the prior of {rv.name!r} has a support that cannot be stretched (as that of a "
            "probability, a simplex, an angle or a covariance): leave it out of var_names"
        )


def _reweighted(
    rv: TensorVariable, value: TensorVariable, width: TensorVariable, size: int
) -> tuple[TensorVariable, TensorVariable]:
    """Log-ratio of the densities, and what may lie beyond the bounds, of one variable."""
    lower, upper = _bounds(rv)
    on_left = pt.eq(lower, 0) | (pt.isfinite(lower) & pt.isinf(upper))
    on_right = pt.eq(upper, 0) | (pt.isfinite(upper) & pt.isinf(lower))
    centre = pt.switch(on_left, lower, pt.switch(on_right, upper, support_point(rv)))
    stretched = pm.logp(rv, centre + (value - centre) / width).sum() - size * pt.log(width)
    beyond = _beyond(value, lower, upper, centre, width)
    return stretched - pm.logp(rv, value).sum(), beyond


def _bounds(rv: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
    """Ends of the support, infinite where it has none."""
    support = _default_transform(rv.owner.op, rv)
    ends: tuple[TensorVariable | None, TensorVariable | None] = (None, None)
    if isinstance(support, LogTransform):
        ends = (pt.constant(0.0), None)
    elif isinstance(support, IntervalTransform):
        ends = support.args_fn(*rv.owner.inputs)
    lower, upper = ends
    return (
        pt.constant(-np.inf) if lower is None else lower,
        pt.constant(np.inf) if upper is None else upper,
    )


def _beyond(
    value: TensorVariable,
    lower: TensorVariable,
    upper: TensorVariable,
    centre: TensorVariable,
    width: TensorVariable,
) -> TensorVariable:
    """Bound what a wider prior adds beyond a bounded support, where there are no draws.

    If neither the likelihood nor the prior rises outwards from the `EDGE` of the support, what lies
    beyond is at most the share of the draws in that edge, times how many edges would fit there.
    """
    length = upper - lower
    n_edges = pt.maximum(width - 1, 0) / EDGE
    at_lower = (value < lower + EDGE * length) * (centre - lower)
    at_upper = (value > upper - EDGE * length) * (upper - centre)
    bounded = pt.isfinite(length)
    return pt.switch(bounded, n_edges * (at_lower + at_upper) / length, 0.0).sum()
