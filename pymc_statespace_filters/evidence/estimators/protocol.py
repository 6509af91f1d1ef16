"""The contract of an evidence estimator: what it is given and what it returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from ..posterior import Posterior


@dataclass(frozen=True)
class Estimate:
    """A log-evidence, its standard error, and how they were obtained.

    Attributes
    ----------
    log_evidence : float
    se : float
        Numerical standard error; NaN if the estimator has none.
    settings : mapping of str to float
        Settings and diagnostics (scales, counts, effective sample sizes), stored in the group
        ``evidence`` beside the estimate.
    doubts : tuple of str
        Reasons why the error may be larger than `se`, each with a remedy.
    shortfall : str
        Why `se` is larger than the ``target_se`` of the estimator, with a remedy; empty if it is
        not, or if the estimator has none.
    """

    log_evidence: float
    se: float
    settings: Mapping[str, float] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    shortfall: str = ""


@runtime_checkable
class Estimator(Protocol):
    """An algorithm that estimates the evidence from posterior draws and a log-density.

    Any object with these three members can be passed to `estimate_evidence`. Its own settings are
    its attributes, checked when it is constructed; it raises `ModelError` for a model that it
    cannot treat. A frozen dataclass with a field ``target_se`` that is None gets that of
    `estimate_evidence`. It is given draws of chains at the posterior itself.

    Examples
    --------
    Importance sampling from a normal distribution fitted to the draws:

    >>> import numpy as np
    >>> from scipy.stats import multivariate_normal
    >>> from pymc_statespace_filters.evidence.estimators import Estimate
    >>> class NormalImportance:
    ...     name = "normal_importance"
    ...
    ...     def n_evaluations(self, posterior):
    ...         return 1000
    ...
    ...     def estimate(self, posterior, *, rng):
    ...         draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    ...         q = multivariate_normal(draws.mean(axis=0), np.cov(draws.T))
    ...         x = q.rvs(1000, random_state=rng).reshape(1000, -1)
    ...         weights = np.exp(posterior.evaluate(x, rng) - q.logpdf(x))
    ...         se = weights.std() / weights.mean() / 1000**0.5
    ...         return Estimate(float(np.log(weights.mean())), float(se))

    It estimates the evidence of a model beside a built-in estimator:

    >>> import arviz as az
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> normals = np.random.default_rng(1).standard_normal((4, 1000))
    >>> idata = az.from_dict({"posterior": {"mu": 4 / 13 + normals / np.sqrt(3.25)}})
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     found = psf.estimate_evidence(
    ...         idata, estimators=["bridge", NormalImportance()], random_seed=2
    ...     )
    >>> list(found), bool(found.agreement)
    (['bridge', 'normal_importance'], True)
    """

    @property
    def name(self) -> str:
        """Name under which the estimate is returned and stored."""

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence.

        Parameters
        ----------
        posterior : Posterior
            Unconstrained draws with their log-densities, and functions that evaluate the
            log-density and the prior at further points.
        rng : numpy.random.Generator
            The only source of randomness.
        """

    def n_evaluations(self, posterior: Posterior) -> int:
        """Approximate number of log-density evaluations, for the progress bar."""
