"""Evidence under wider or narrower priors, by reweighting the posterior draws.

A prior p scaled by the factor w about c is p_w(phi) = p(c + (phi - c) / w) / w. The draws under p
give its evidence, without new likelihood evaluations:

    Z_w / Z = E[p_w(phi) / p(phi)],   phi from the posterior under p.

The centre c is the end of a half-line, or an end at zero, so that the scaled prior of a positive
quantity has the same support; otherwise it is PyMC's support point. A prior that depends on other
variables is scaled conditionally on them.

The sum of the log-ratios of several priors is that of all of them together.
"""

from collections.abc import Iterable, Sequence
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
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.rows import at_points
from ...errors import ModelError
from ...pymc_model.ends_of_support import bounds_of_support
from ...pymc_model.posterior_draws import populations_of
from ...pymc_model.prior import can_sample
from ...statistics.importance import (
    MIN_EFFECTIVE,
    SAME,
    log_mean,
    log_mean_of_draws,
    mcse,
    pareto_k,
)

EDGE = 0.05  # fraction of a bounded support, at each end
# Limits beyond which the reweighted evidence is unreliable.
MAX_PARETO_K = 0.5  # above, the weights have no variance and their mean no standard error
MAX_BEYOND = 0.02

Array = NDArray[np.float64]


class ReweightedEvidence(NamedTuple):
    """The evidence under scaled priors relative to that under the original ones."""

    log_ratio: float  # ln Z_w - ln Z
    error: float  # its standard error
    n_effective: float  # effective number of draws: of independent terms of relative variance one
    pareto_k: float  # shape of the upper tail of the weights
    beyond: float  # upper bound of the fraction of Z_w where the original prior is zero

    @property
    def is_reliable(self) -> bool:
        """Whether there are enough effective draws and they cover the scaled prior."""
        return (
            self.n_effective >= MIN_EFFECTIVE
            and self.pareto_k <= MAX_PARETO_K
            and self.beyond <= MAX_BEYOND
        )

    @property
    def reason(self) -> str:
        """Why it is unreliable, if it is."""
        if self.beyond > MAX_BEYOND:
            return "the posterior reaches the end of the support, and no draws lie beyond it"
        if self.pareto_k > MAX_PARETO_K:
            return "the posterior is nearly as wide as the prior"
        return f"fewer than {MIN_EFFECTIVE:g} effective draws lie under a scaled prior"


UNCHANGED = ReweightedEvidence(0.0, 0.0, np.inf, -np.inf, 0.0)
UNKNOWN = ReweightedEvidence(np.nan, np.nan, 0.0, np.inf, 0.0)


class ScaledPrior:
    """The priors of some free variables of a model, scaled by a common factor.

    Raises `ModelError` if a prior is improper or its support cannot be scaled.
    """

    def __init__(self, model: pm.Model, names: Iterable[str]) -> None:
        self.names = tuple(names)
        scaled = [model[name] for name in self.names]
        for rv in scaled:
            _check_scalable(rv, model)
        width = pt.dscalar("width")
        values = {rv: rv.type(name=rv.name) for rv in model.free_RVs}
        sizes = {name: int(np.prod(shape)) for name, shape in model.eval_rv_shapes().items()}
        terms = [_log_ratio(rv, values[rv], width, sizes[rv.name]) for rv in scaled]
        outputs = [pt.stack(of_each) for of_each in zip(*terms, strict=True)]
        self._types = {value.name: value.dtype for value in values.values()}
        points, at_draws = at_points(list(values.values()), clone_replace(outputs, values))
        # One call handles all draws, which is not worth machine code.
        self._function = compile_pymc(
            [width, *points], at_draws, on_unused_input="ignore", mode="FAST_COMPILE"
        )

    def curve(
        self,
        idata: xr.DataTree,
        widths: Sequence[float] | Array,
        names: Iterable[str] | None = None,
        log_terms: Array | None = None,
    ) -> list[ReweightedEvidence]:
        """The evidence at every width, from draws; of some of the priors, if ``names`` are given.

        With ``log_terms`` (chain, draw), whose mean the evidence is to be divided by, the error is
        that of the quotient: both means are of the same draws.
        """
        chosen = [i for i, name in enumerate(self.names) if names is None or name in names]
        if not chosen:
            return [UNCHANGED] * len(widths)
        posterior, population = idata["posterior"].to_dataset(), populations_of(idata)

        def at(width: float) -> ReweightedEvidence:
            found = self.log_ratios(posterior, width)
            log_ratio, beyond = (one[..., chosen].sum(axis=-1) for one in found)
            mean = average_ratios(log_ratio, beyond, population)
            if log_terms is None or not mean.is_reliable:
                return mean
            terms = np.exp(log_ratio - mean.log_ratio) - np.exp(log_terms - log_mean(log_terms))
            return mean._replace(error=mcse(terms, population))

        return [at(float(width)) for width in widths]

    def log_ratios(self, posterior: xr.Dataset, width: float) -> tuple[Array, Array]:
        """Log-ratios p_w / p at the draws (chain, draw, prior), and their `_beyond`."""
        shape = posterior.sizes["chain"], posterior.sizes["draw"], len(self.names)
        rows = [
            np.concatenate(posterior[name].transpose("chain", "draw", ...).values).astype(dtype)
            for name, dtype in self._types.items()
        ]
        with np.errstate(all="ignore"):  # a narrow prior may be zero at a draw
            log_ratio, beyond = self._function(width, *rows)
        return log_ratio.reshape(shape), beyond.reshape(shape)


def average_ratios(
    log_ratio: Array, beyond: Array, population: NDArray[np.int64] | None = None
) -> ReweightedEvidence:
    """Average the ratios p_w / p of draws (chain, draw), with diagnostics from their `_beyond`.

    ``population`` (chain, draw) is as in `mcse`.
    """
    peak = log_ratio.max()
    if np.isneginf(peak):
        return ReweightedEvidence(-np.inf, np.inf, 0.0, np.inf, 0.0)
    fraction = float(np.average(beyond, weights=np.exp(log_ratio - peak)))
    if np.ptp(log_ratio) < SAME:  # a wider Uniform prior: all weights are equal
        return ReweightedEvidence(float(peak), 0.0, np.inf, -np.inf, fraction)
    mean = log_mean_of_draws(log_ratio, population)
    return ReweightedEvidence(
        mean.value, mean.error, mean.n_effective, pareto_k(log_ratio), fraction
    )


def _check_scalable(rv: TensorVariable, model: pm.Model) -> None:
    op = rv.owner.op
    if not can_sample(rv, model):
        raise ModelError(f"the prior of {rv.name!r} is improper and cannot be scaled")
    support = _default_transform(op, rv)
    if op.ndim_supp > 1 or not isinstance(support, IntervalTransform | LogTransform | None):
        raise ModelError(
            f"the prior of {rv.name!r} has a support that cannot be scaled (a probability, a "
            "simplex, an angle or a covariance): leave it out of var_names"
        )


def _log_ratio(
    rv: TensorVariable, value: TensorVariable, width: TensorVariable, size: int
) -> tuple[TensorVariable, TensorVariable]:
    """Log-ratio of the scaled and original density of one variable, and `_beyond`."""
    lower, upper = bounds_of_support(rv)
    on_left = pt.eq(lower, 0) | (pt.isfinite(lower) & pt.isinf(upper))
    on_right = pt.eq(upper, 0) | (pt.isfinite(upper) & pt.isinf(lower))
    centre = pt.switch(on_left, lower, pt.switch(on_right, upper, support_point(rv)))
    scaled = pm.logp(rv, centre + (value - centre) / width).sum() - size * pt.log(width)
    beyond = _beyond(value, lower, upper, centre, width)
    return scaled - pm.logp(rv, value).sum(), beyond


def _beyond(
    value: TensorVariable,
    lower: TensorVariable,
    upper: TensorVariable,
    centre: TensorVariable,
    width: TensorVariable,
) -> TensorVariable:
    """Bound the fraction that a wider prior adds outside a bounded support, without draws there.

    If neither the likelihood nor the prior increases outwards from the `EDGE` of the support, the
    fraction is at most that of the draws in the edge, times the number of edges that fit outside.
    """
    length = upper - lower
    n_edges = pt.maximum(width - 1, 0) / EDGE
    at_lower = (value < lower + EDGE * length) * (centre - lower)
    at_upper = (value > upper - EDGE * length) * (upper - centre)
    bounded = pt.isfinite(length)
    return pt.switch(bounded, n_edges * (at_lower + at_upper) / length, 0.0).sum()
