"""``find_starts``: initial values of chains that lie in the posterior."""

import numpy as np
from pymc.model import Model

from ...errors import ModelError
from ...facts import tell
from ...pymc_model.at_points import ConstrainedValues
from ...pymc_model.inspection import given_model
from ...system.checks import check_count, check_flag, check_random_seed
from ..output.facts import SeparateModes
from .population import N_POINTS, population_of


def find_starts(
    model: Model | None = None,
    *,
    chains: int = 4,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> list[dict[str, np.ndarray]]:
    """Find initial values of chains in the posterior, however narrow it is.

    256 draws of the prior are led to the posterior through some ten to twenty distributions, from
    the prior times a small power of the likelihood to the posterior. The starts are points of this
    population. They lie in the modes that it has met, as often as these have mass. A chain that
    starts at a draw of the prior may stay for good on a ridge far from the posterior: a wrong
    frequency of an oscillator, for example.

    Parameters
    ----------
    model : pymc.Model, optional
        Default: the model of the ``with`` block. Its free variables must be continuous, and their
        priors proper.
    chains : int
        Number of starts, at most 256.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool
        Whether to show the progress, if it takes longer than two seconds.

    Returns
    -------
    list of dict
        For every chain the values of the free variables, as ``initvals`` of `sample_dram` and of
        ``pm.sample``.

    Raises
    ------
    ModelError
        If an argument is not as described, a prior cannot be drawn from, or no draw of the prior
        has a positive likelihood.

    Notes
    -----
    If the log-density falls by more than 5 nats between groups of the points, a warning of PyMC's
    logger says that there are separate modes, where, and with which shares and log-densities.

    The cost is 3000 to 16 000 evaluations of the log-density, in threads: more, the narrower the
    posterior is. If the filters are expensive and the systems allow an `EKF`, the population is
    first led to the prior times the square root of its likelihood. From nine parameters on, an
    `IPLF` does so for counts, and if the log-density or that with this filter has a gradient, the
    points then make 12 to 160 moves along it, with a metric found from their gradients; the
    gradient takes seconds to compile.

    `sample_dram` finds starts in this way itself.

    References
    ----------
    Del Moral, Doucet and Jasra (2006), Journal of the Royal Statistical Society B 68, 411-436.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 1000)
    ...     y = pm.Normal("y", mu, 0.1, observed=[1.2, 1.1, 1.3, 1.2])
    ...     starts = psf.find_starts(random_seed=1, progressbar=False)
    ...     idata = psf.sample_dram(initvals=starts, random_seed=1, progressbar=False)
    >>> [bool(1.0 < start["mu"] < 1.4) for start in starts]
    [True, True, True, True]
    """
    model = given_model(model)
    check_count("chains", chains, 1)
    check_flag("progressbar", progressbar)
    if chains > N_POINTS:
        raise ModelError(f"chains must be at most {N_POINTS}, got {chains}")
    rng = check_random_seed(random_seed)
    found, raveled = population_of(model, rng, progressbar=progressbar)
    tell(SeparateModes(model, raveled, found))
    chosen = rng.choice(len(found.x), chains, replace=chains > len(found.x))
    values = ConstrainedValues(model)
    return [values(x) for x in found.x[chosen]]
