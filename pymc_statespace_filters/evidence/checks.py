"""Checks of an evidence that do not depend on the estimator.

Every estimate relies on the convergence of the chains; and a posterior may reach the stability
limit of the integrator.

An integrator states whether its steps are stable (`Integrator.is_stable_at`).

An Euler-Maruyama step multiplies a small deviation by 1 + a h, where the exact solution multiplies
it by exp(a h). For -2 < a h < -1 the step overshoots: the path oscillates from step to step, unlike
any exact path; for a h < -2 it diverges. Under a wide prior this has two effects on a posterior,
and both vanish with steps half as long:

* Draws whose likelihood is due to overshooting. Observed every n steps, such a path has the
  autocorrelation (1 + a h)^n, so that an even n gives a mirror mode at -2 / h - a.
* A posterior that ends where the steps become unstable. Points beyond the draws have a likelihood
  with steps half as long, and none or a far smaller one with the steps of the model.

Points whose steps do not overshoot are not examined, however much their likelihood depends on the
step length: that is the accuracy of the discretisation, a different question.
"""

import math
from collections.abc import Iterator

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import rankdata

from ..errors import ModelError
from ..pymc_model.density import RowFunction
from ..pymc_model.elements import labels_of
from ..pymc_model.posterior_draws import STEP_CHECK, STEP_NATS
from ..pymc_model.step_refinement import densities_by_halvings, step_stability
from ..statistics.lower_chains import lower_chains
from .observed_data import observed_in, scalar_count
from .posterior import Posterior

MAX_RHAT = 1.05
# Effective draws of all chains with which R-hat and ESS are reliable (Vehtari et al. 2021).
ENOUGH_EFFECTIVE = 400

# By which half the step may change the log-evidence: odds of 5 to 3.
MOST_NATS = 0.5
N_DRAWS = 100
MIN_DRAWS = 2  # affected; a single one may be chance
LOSS = 5.0  # nats per point, by halving the steps
# Nats per observed scalar. A linear state without overshooting loses at most 0.12, at 1 + a h = 0.
LOSS_OF_A_SCALAR = 0.15
BEYOND = 1.5  # factor by which the draws are spread about their mean, to probe beyond them
MIN_BEYOND = 0.05  # fraction of the posterior
MIN_SEPARATION = 0.9  # fraction of pairs that a parameter must order alike to be named
Array = NDArray[np.float64]


def check_convergence(posterior: Posterior, idata: xr.DataTree | None = None) -> Iterator[str]:
    """Yield a reason to distrust every estimate from the draws if the chains disagree.

    As a rule of thumb, the effective sample size grows with the number of draws: the factor by
    which draws are missing is `ENOUGH_EFFECTIVE` over the smallest one, at least 2. More draws do
    not help where a chain stays far below another one. ``idata`` tells which sampler drew them.
    """
    if posterior.population is not None:
        return
    from arviz_stats import ess, rhat  # loads much: see `importance`

    parameters = np.moveaxis(posterior.draws, -1, 0)
    with np.errstate(invalid="ignore"):  # R-hat of a constant parameter is 0 / 0
        rhats = [float(rhat(values)) for values in parameters]
    largest = max((one for one in rhats if not np.isnan(one)), default=1.0)
    if largest <= MAX_RHAT:
        return
    found = f"the chains disagree (R-hat {largest:.2f})"
    if low := lower_chains(dict(enumerate(posterior.log_density)), len(parameters)):
        lowest = max(low, key=lambda chain: chain.nats)
        yield f"{found}: {lowest}: start it where the others are (initvals), or tune longer"
        return
    poor = [v for v, one in zip(parameters, rhats, strict=True) if one > MAX_RHAT]
    effective = min(float(ess(v)) for v in poor)
    factor = max(2, math.ceil(ENOUGH_EFFECTIVE / max(effective, 1.0)))
    how = f"draws={factor * parameters.shape[-1]}"
    if _drawn_by_us(idata):
        how = f"until_ess={ENOUGH_EFFECTIVE} of sample_dram"
    yield (
        f"{found}: their effective sample size is {effective:.0f}; {how} would give "
        f"{ENOUGH_EFFECTIVE}, with about {factor} times as many iterations. If R-hat stays above "
        f"{MAX_RHAT}, start the chains elsewhere (initvals) or tune longer"
    )


def _drawn_by_us(idata: xr.DataTree | None) -> bool:
    """Whether the draws are those of `sample_dram`, which notes whether they are exact."""
    return idata is not None and "refresh_noise" in idata.attrs


def check_steps(model: pm.Model, idata: xr.DataTree, draws: Array) -> list[str]:
    """What is wrong with the integration steps at draws, or was found so when the run ended."""
    found = list(check_discretisation(model, idata, draws))
    if not found and (known := idata.attrs.get(STEP_CHECK)):
        found = [f"{known[0].lower()}{known[1:].rstrip('.')}"]
    elif not found and abs(nats := idata.attrs.get(STEP_NATS, 0.0)) > MOST_NATS:
        found = [
            f"with integration steps half as long the log-evidence changes by {nats:+.1f} nats: "
            f"multiply substeps by four until step_error finds less than {MOST_NATS:g}"
        ]
    return found


def check_discretisation(model: pm.Model, idata: xr.DataTree, draws: Array) -> Iterator[str]:
    """Yield a reason if draws (chain, draw, k) overshoot, or end at the stability limit.

    Models without an integrator, and systems that their filter cannot treat with shorter steps, are
    not checked.
    """
    is_stable = step_stability(model)
    if is_stable is None:
        return
    flat = draws.reshape(-1, draws.shape[-1])
    chosen = np.linspace(0, len(flat) - 1, min(N_DRAWS, len(flat))).astype(int)
    x = flat[chosen]
    beyond = flat.mean(axis=0) + BEYOND * (x - flat.mean(axis=0))
    # The eigenvalues are cheap; what follows compiles two filters, which few models need.
    overshoots = ~is_stable(np.concatenate([x, beyond]))
    if overshoots.sum() < MIN_DRAWS:
        return
    try:
        densities = densities_by_halvings(model, 1)
    except ModelError:
        return
    coarse, fine = (RowFunction(model, density).evaluate for density in densities)
    limit = max(LOSS, LOSS_OF_A_SCALAR * scalar_count(observed_in(model)))
    coarse_x, fine_beyond = coarse(x), fine(beyond)
    with np.errstate(invalid="ignore"):  # -inf minus -inf
        lost = coarse_x - fine(x)
        gained = fine_beyond - coarse(beyond)

    affected = overshoots[: len(x)] & (lost > limit)
    if affected.sum() >= MIN_DRAWS:
        yield (
            f"{affected.mean():.0%} of the draws{_separating(model, idata, chosen, affected)} have "
            "a likelihood due to integration steps that overshoot: with steps half as long they "
            f"lose {_range(lost[affected])} nats. They lie near the stability limit of the "
            "integrator and are no solutions of the equation: raise substeps, or give a prior that "
            "excludes them"
        )
    # The draws have density coarse(x): these weights turn them to the posterior of half the step.
    usable = np.isfinite(coarse_x)
    unstable = (
        softmax((fine_beyond - coarse_x)[usable])
        @ (overshoots[len(x) :] & (gained > limit))[usable]
    )
    if unstable > MIN_BEYOND:
        yield (
            "the posterior ends where the integration steps become unstable: with steps half as "
            f"long about {unstable:.0%} of it would lie beyond; raise substeps, or give a narrower "
            "prior"
        )


def _separating(
    model: pm.Model, idata: xr.DataTree, chosen: NDArray[np.int64], affected: NDArray[np.bool_]
) -> str:
    """Name and range of the parameter that separates the affected draws from the others, if any."""
    if affected.all():
        return ""
    columns = dict(_scalars(model, idata, chosen))
    separation = {name: _separation(values, affected) for name, values in columns.items()}
    best = max(separation, key=lambda name: separation[name])
    if separation[best] < MIN_SEPARATION:
        return ""
    values = columns[best]
    return f" ({best} in {_range(values[affected])}, the others in {_range(values[~affected])})"


def _scalars(
    model: pm.Model, idata: xr.DataTree, chosen: NDArray[np.int64]
) -> Iterator[tuple[str, Array]]:
    """Name and chosen draws of every scalar of the free variables."""
    for rv in model.free_RVs:
        values = idata["posterior"][rv.name].transpose("chain", "draw", ...).values
        values = values.reshape(-1, *values.shape[2:])[chosen]
        labels = labels_of(rv.name, values.shape[1:], model)
        yield from zip(labels, values.reshape(len(chosen), -1).T, strict=True)


def _separation(values: Array, affected: NDArray[np.bool_]) -> float:
    """Fraction of pairs, one affected and one not, that are ordered alike by the values (AUC)."""
    n, m = affected.sum(), (~affected).sum()
    auc = (rankdata(values)[affected].sum() - n * (n + 1) / 2) / (n * m)
    return float(max(auc, 1 - auc))


def _range(values: Array) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"
