"""Whether a posterior reaches the stability limit of the integrator.

An Euler-Maruyama step multiplies a small deviation by 1 + a h, where the equation multiplies it by
exp(a h). Where -2 < a h < -1 the step overshoots: the path oscillates from step to step as no path
of the equation does, and it grows without bound from there on. This leaves two marks on a posterior
under a wide prior, and both vanish with steps half as long:

* Draws that owe their likelihood to the overshooting. Seen every n steps such a path looks as if
  it were correlated by (1 + a h)^n, so that with an even n there is a mirror mode at -2 / h - a.
* An end of the posterior where the steps become unstable. Points beyond the draws have a
  likelihood with steps half as long, and none, or a far smaller one, as it is.

Points whose steps do not overshoot are left alone, however much their likelihood depends on the
length of the step: that is the accuracy of the discretisation, and another question.
"""

from collections.abc import Iterator

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import rankdata

from pymc_statespace_filters.evidence.posterior.density import RowFunction
from pymc_statespace_filters.evidence.posterior.observed_data import scalar_count
from pymc_statespace_filters.pymc_model.step_refinement import densities_by_steps, step_multipliers

N_DRAWS = 100
MIN_DRAWS = 2  # one may be chance
LOSS = 5.0  # nats, of a point
# Nats. A linear state loses less if its steps do not overshoot: 0.12 if 1 + a h = 0, at the worst.
LOSS_OF_A_SCALAR = 0.15
BEYOND = 1.5  # by which the draws are spread out, to look where they end
MIN_SHARE = 0.05
MIN_SEPARATION = 0.9  # share of pairs that a parameter must put in order

Array = NDArray[np.float64]


def check_discretisation(model: pm.Model, idata: xr.DataTree, draws: Array) -> Iterator[str]:
    """Say if draws (chain, draw, k) owe their likelihood to overshooting, or end at its limit.

    Nothing is said of models without Euler-Maruyama steps, or with a system that no deterministic
    filter can treat.
    """
    multipliers = step_multipliers(model)
    if multipliers is None:
        return
    flat = draws.reshape(-1, draws.shape[-1])
    chosen = np.linspace(0, len(flat) - 1, min(N_DRAWS, len(flat))).astype(int)
    x = flat[chosen]
    beyond = flat.mean(axis=0) + BEYOND * (x - flat.mean(axis=0))
    # This takes a moment, the rest must compile two filters: most models need not go on.
    overshoots = multipliers(np.concatenate([x, beyond])) < 0
    if overshoots.sum() < MIN_DRAWS or (densities := densities_by_steps(model)) is None:
        return
    coarse, fine = (RowFunction(model, density).evaluate for density in densities)
    limit = max(LOSS, LOSS_OF_A_SCALAR * scalar_count(model))
    coarse_x, fine_beyond = coarse(x), fine(beyond)
    with np.errstate(invalid="ignore"):  # of two densities of zero
        lost = coarse_x - fine(x)
        gained = fine_beyond - coarse(beyond)

    guilty = overshoots[: len(x)] & (lost > limit)
    if guilty.sum() >= MIN_DRAWS:
        yield (
            f"{guilty.mean():.0%} of the draws{_separating(model, idata, chosen, guilty)} owe "
            "their likelihood to integration steps that overshoot: with steps half as long they "
            f"lose {_range(lost[guilty])} nats. They lie at the limit of stability and say nothing "
            "of the equation: raise substeps, or give a prior that excludes them"
        )
    # The draws' density is coarse(x), so that these weigh the points as steps half as long would.
    usable = np.isfinite(coarse_x)
    share = (
        softmax((fine_beyond - coarse_x)[usable])
        @ (overshoots[len(x) :] & (gained > limit))[usable]
    )
    if share > MIN_SHARE:
        yield (
            "the posterior ends where the integration steps become unstable: with steps half as "
            f"long it would go on (some {share:.0%} of it lie beyond): raise substeps, or give a "
            "narrower prior"
        )


def _separating(
    model: pm.Model, idata: xr.DataTree, chosen: NDArray[np.int64], guilty: NDArray[np.bool_]
) -> str:
    """Name and range of the parameter that tells the guilty draws from the others, if one does."""
    if guilty.all():
        return ""
    columns = dict(_scalars(model, idata, chosen))
    separation = {name: _separation(values, guilty) for name, values in columns.items()}
    best = max(separation, key=lambda name: separation[name])
    if separation[best] < MIN_SEPARATION:
        return ""
    values = columns[best]
    return f" ({best} in {_range(values[guilty])}, the others in {_range(values[~guilty])})"


def _scalars(
    model: pm.Model, idata: xr.DataTree, chosen: NDArray[np.int64]
) -> Iterator[tuple[str, Array]]:
    """The chosen draws of every scalar of the free variables, by its name."""
    for rv in model.free_RVs:
        values = idata["posterior"][rv.name].transpose("chain", "draw", ...).values
        values = values.reshape(-1, *values.shape[2:])[chosen]
        for index in np.ndindex(values.shape[1:]):
            label = f"[{', '.join(map(str, index))}]" if index else ""
            yield f"{rv.name}{label}", values[(slice(None), *index)]


def _separation(values: Array, guilty: NDArray[np.bool_]) -> float:
    """Share of the pairs, one guilty and one not, that the values put in one order."""
    n, m = guilty.sum(), (~guilty).sum()
    share = (rankdata(values)[guilty].sum() - n * (n + 1) / 2) / (n * m)
    return float(max(share, 1 - share))


def _range(values: Array) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"
