"""The update of a Gaussian filter by censored observations: assumed-density filtering.

State and observation are jointly Gaussian. Of a component y that is only known to lie on one side
of a limit, the density is the probability of that side, and mean and variance of the truncated law
take the place of m and v of y,

    (m, v) -> (m', v'),    x -> x + C / v (m' - m),    P -> P - C C' / v (1 - v' / v)

with the covariance C of x and y, and so for the components that remain. Those that are not censored
come first, then the others in the order of columns: the moments of more than one truncation depend
on that order, and are approximate, as the next prediction from a Gaussian is.

A truncation does to the state what an observation of y with more noise would do, of the variance
v v' / (v - v') and the value m + v (m' - m) / (v - v'). Put in place of the censored ones, such
observations leave the equations of update and smoother as they are.
"""

from typing import NamedTuple

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...compiler.numerics.small_cholesky import LOG_TWO_PI
from ...system.normal_below import excess, hazard, log_probability, variance

# Of v, what a truncation takes at least: then the noise that stands for it is not infinite.
_LEAST_TAKEN = 1e-30


class Truncated(NamedTuple):
    """Observations in place of censored ones, and the log of the density of all of them.

    ``more_noise`` (p,) are the variances to add to those of the noise, zero where not censored.
    """

    residual: TensorVariable
    more_noise: TensorVariable
    term: TensorVariable


def truncate(
    residual: TensorVariable, cov: TensorVariable, observed: TensorVariable, flags: TensorVariable
) -> Truncated:
    """Truncate the law of the observations, whose residuals have the covariance ``cov`` (p, p).

    ``observed`` (p,) is 1 for what is not missing, and ``flags`` (p,) are -1 where the true value
    lies below the number recorded, 1 where above, and 0 for a measured one.
    """
    p = residual.type.shape[0]
    is_censored = pt.cast(pt.neq(flags, 0.0), "float64")
    mean, terms = pt.zeros((p,)), []
    for i in range(p):
        is_seen = observed[i] * (1.0 - is_censored[i])
        v = pt.switch(is_seen, cov[i, i], 1.0)
        off = residual[i] - mean[i]
        terms.append(-0.5 * is_seen * (off**2 / v + pt.log(v) + LOG_TWO_PI))
        gain = cov[:, i] / v
        mean, cov = mean + is_seen * off * gain, cov - is_seen * pt.outer(gain, cov[i])
    values, more_noise = [], []
    for i in range(p):
        is_cut = observed[i] * is_censored[i]
        v = pt.switch(is_cut, cov[i, i], 1.0)
        sd = pt.sqrt(v)
        z = flags[i] * (mean[i] - residual[i]) / sd
        taken = is_cut * hazard(z) * excess(z)
        terms.append(is_cut * log_probability(z))
        values.append(pt.switch(is_cut, mean[i] + flags[i] * sd / excess(z), residual[i]))
        more_noise.append(is_cut * v * variance(z) / pt.maximum(taken, _LEAST_TAKEN))
        gain = cov[:, i] / v
        mean = mean + is_cut * flags[i] * sd * hazard(z) * gain
        cov = cov - taken * pt.outer(gain, cov[i])
    return Truncated(pt.stack(values), pt.stack(more_noise), sum(terms[1:], terms[0]))
