"""Distributions for ``process_dist`` that compartment models are made of."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_positive
from .distributions.vector import conditional_shares


def euler_multinomial(size: Any, rates: Sequence[Any], dt: Any) -> list[TensorVariable]:
    r"""How many members of a compartment leave it by each of several exits during a step.

    With the total rate :math:`R = \sum_i r_i`, each member leaves with probability
    :math:`p = 1 - \exp(-R\,dt)`, by exit i with probability :math:`p_i = p\, r_i / R`, independent
    of the others. So exit i takes a number of mean :math:`n p_i`, variance
    :math:`n p_i (1 - p_i)` and covariance :math:`-n p_i p_j` with exit j. All exits together take
    at most n members.

    Parameters
    ----------
    size : symbol or int
        Number n of members.
    rates : sequence of symbol or float
        Rate of each exit per member and time, at least 0.
    dt : symbol or float
        Length of the step.

    Returns
    -------
    list of TensorVariable
        One distribution for each exit, for the list that ``process_dist`` returns: a binomial one
        of the members that the exits before it left.

    Raises
    ------
    ModelError
        If there is no rate, or a number among the arguments is negative.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> import pymc as pm
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q: [x[0] - q[0] - q[1], x[1] + q[0] - q[2]],
    ...     process_dist=lambda x, infect, die, recover: [
    ...         *psf.compartments.euler_multinomial(x[0], [infect * x[1], die], 0.1),
    ...         *psf.compartments.euler_multinomial(x[1], [recover], 0.1),
    ...     ],
    ...     observation_dist=lambda x: [pm.Poisson.dist(0.3 * x[1] + 0.1)],
    ...     initial_dist=lambda: [990, 10],
    ... )
    >>> system.m
    3
    """
    rates = list(rates) if isinstance(rates, Sequence | np.ndarray) else rates
    if not isinstance(rates, list) or not rates:
        raise ModelError(f"rates must be a list with the rate of each exit, got {rates!r}")
    for name, values in (("size", [size]), ("rates", rates), ("dt", [dt])):
        for value in values:
            if isinstance(value, int | float) and not value >= 0:
                raise ModelError(f"{name} of euler_multinomial must be at least 0, got {value!r}")
    symbols = [pt.cast(pt.as_tensor(rate), "float64") for rate in rates]
    total = sum(symbols[1:], start=symbols[0])
    # Below zero this is no probability, and shares stay negative where a rate is: no binomial law.
    is_positive = pt.gt(total, 0)
    safe = pt.switch(is_positive, total, 1.0)
    leaving = pt.switch(is_positive, -pt.expm1(-safe * dt) / safe, dt)
    shares = conditional_shares([rate * leaving for rate in symbols], pt.exp(-total * dt))
    left, exits = size, []
    for share in shares:
        exits.append(pm.Binomial.dist(n=left, p=share))
        left = left - exits[-1]
    return exits


def gamma_white_noise(sigma: Any, dt: Any) -> TensorVariable:
    r"""A random factor of a rate during a step: Gamma-distributed, of mean 1.

    .. math:: \Delta W / dt, \qquad \mathrm{E} = 1, \qquad \mathrm{Var} = \sigma^2 / dt

    with increments :math:`\Delta W` of a Gamma process, of mean :math:`dt` and variance
    :math:`\sigma^2 dt`. A rate times this factor stays positive, and its noise has the same
    strength for any length of the step.

    Parameters
    ----------
    sigma : symbol or float
        Intensity of the noise, above 0; the square root of a time.
    dt : symbol or float
        Length of the step, above 0.

    Returns
    -------
    TensorVariable
        A distribution, as a factor in the parameters of others that ``process_dist`` returns.

    Raises
    ------
    ModelError
        If a number among the arguments is not positive.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> import pymc as pm
    >>> def process_dist(x, rate, sigma):
    ...     factor = psf.compartments.gamma_white_noise(sigma, dt=0.1)
    ...     return [pm.Poisson.dist(rate * x[0] * factor * 0.1)]
    """
    for name, value in (("sigma", sigma), ("dt", dt)):
        if isinstance(value, int | float):
            check_positive(name, value)
    shape = pt.as_tensor(dt / sigma**2)
    return pm.Gamma.dist(alpha=shape, beta=shape)
