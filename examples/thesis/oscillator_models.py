"""The unknowns of the mass-spring-damper as PyMC models, in coordinates that mix."""

from collections.abc import Collection
from functools import partial

import pymc as pm
from oscillator import NONLINEARITIES, Case

import pymc_statespace_filters as psf

# The thesis states no priors. These are proper, vague on the scale of a mass of 1 kg that moves by
# metres in seconds, and zero where a negative value would mean a spring or a damper that drives.
PRIORS = {
    "k_l": partial(pm.HalfNormal, sigma=2.0),
    "c": partial(pm.HalfNormal, sigma=1.0),
    "sigma": partial(pm.HalfNormal, sigma=0.5),
    "k_nl": partial(pm.Normal, mu=0.0, sigma=2.0),
    "k_f": partial(pm.HalfNormal, sigma=2.0),
    "delta_f": partial(pm.HalfNormal, sigma=1.0),
    "k_h": partial(pm.HalfNormal, sigma=2.0),
    "a_h": partial(pm.HalfNormal, sigma=1.0),
    "delta_h": partial(pm.HalfNormal, sigma=2.0),
}
FORCES = {"k_f": "slack", "k_h": "friction"}  # the force that a plateau takes away, in N


def model_of(
    case: Case,
    filter: psf.EKF | psf.EnKF | psf.PFEnKF,
    nonlinearities: Collection[str] = NONLINEARITIES,
    wider: float = 1.0,
) -> pm.Model:
    """Return the model of a record, with some or (by default) all of the nonlinearities.

    The joint prior is exactly that of `PRIORS`, scaled by the given width. But a record does not
    determine k_l, k_f and k_h. It determines their sum, the stiffness far out, and the force that a
    plateau takes away, stiffness times length. In the k's the posterior is a hyperbola and a sharp
    edge, on which chains mix slowly; in these coordinates it has a single hill. A normal prior of k
    is one of k * length, given the length.

    Where the three stiffnesses are known to be equal there is one variable for them, k_l.

    Without a transformation, a bound is an ordinary point to a random walk, not at minus infinity.
    The lengths are transformed to logarithms, because the k's are divided by them.
    """
    bounds = {"default_transform": None}
    sigma = {name: wider * prior.keywords["sigma"] for name, prior in PRIORS.items()}
    with pm.Model() as model:
        for name in ("c", "sigma"):
            PRIORS[name](name, sigma=sigma[name], **bounds)
        if "cubic" in nonlinearities:
            PRIORS["k_nl"]("k_nl", sigma=sigma["k_nl"])
        plateaus = {}  # the length of each, by its stiffness
        if "freeplay" in nonlinearities:
            plateaus["k_f"] = PRIORS["delta_f"]("delta_f", sigma=sigma["delta_f"])
        if "hysteresis" in nonlinearities:
            plateaus["k_h"] = PRIORS["delta_h"]("delta_h", sigma=sigma["delta_h"]) / 2
            PRIORS["a_h"]("a_h", sigma=sigma["a_h"], **bounds)
        if case.shared:
            k_l = PRIORS["k_l"]("k_l", sigma=sigma["k_l"], **bounds)
            for name in plateaus:
                pm.Deterministic(name, k_l)
        else:
            k_of_plateaus = 0.0
            for name, length in plateaus.items():
                force = pm.HalfNormal(FORCES[name], sigma[name] * length, **bounds)
                k_of_plateaus += pm.Deterministic(name, force / length)
            # k_l itself is half-normal: k_far has that prior, shifted by the other stiffnesses.
            k_far = pm.TruncatedNormal(
                "k_far", k_of_plateaus, sigma["k_l"], lower=k_of_plateaus, **bounds
            )
            pm.Deterministic("k_l", k_far - k_of_plateaus)
        case.observe(filter)
    return model
