r"""The evidence under independent normal priors of some terms, in closed form.

As a function of the coefficients :math:`\phi` of p terms, the likelihood (averaged over all other
parameters) is a mixture of normal functions with precisions :math:`\Lambda_k`, which may be
singular:

.. math::

    L(\phi) = \sum_k \exp\left(c_k - \tfrac12 \phi^T \Lambda_k \phi + h_k^T \phi\right).

Under the priors :math:`\phi_j \sim N(0, 1 / \alpha_j)`, with
:math:`P_k = (\Lambda_k + \operatorname{diag} \alpha)^{-1}` and :math:`m_k = P_k h_k`,

.. math::

    Z(\alpha) = \sum_k \exp\left(c_k + \tfrac12 \sum_j \log \alpha_j
        + \tfrac12 \log |P_k| + \tfrac12 h_k^T m_k\right),

and each component of the posterior has the mean :math:`m_k` and the covariance :math:`P_k`
(Sandhu, Khalil, Pettit, Poirel and Sarkar 2021). Derivatives are by :math:`\log \alpha`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

ABSENT = 30.0  # log-precision of a term that is absent, where the coefficients are about one

Array = NDArray[np.float64]


class Derivatives(NamedTuple):
    """Log-evidence at a point, its gradient (p,) and its Hessian (p, p)."""

    value: float
    gradient: Array
    hessian: Array


class TermPosterior(NamedTuple):
    """The posterior of the p coefficients under normal priors: a mixture of normals."""

    weights: Array  # (K,)
    means: Array  # (K, p)
    covs: Array  # (K, p, p)


@dataclass(frozen=True)
class ArdEvidence:
    """The likelihood of p coefficients as a mixture of K normal functions, in units of about one.

    Attributes
    ----------
    log_scales : ndarray (K,)
        The c of the module's formula.
    precisions : ndarray (K, p, p)
    shifts : ndarray (K, p)
        The h.
    """

    log_scales: Array
    precisions: Array
    shifts: Array

    def log_evidence(self, log_alpha: Array) -> Array:
        """At log-precisions (..., p), shape (...)."""
        return np.asarray(logsumexp(self._solved(log_alpha)[0], axis=-1))

    def posterior(self, log_alpha: Array) -> TermPosterior:
        """At log-precisions (p,)."""
        logs, means, covs = self._solved(log_alpha)
        return TermPosterior(softmax(logs), means, covs)

    def relevance(self, log_alpha: Array) -> Array:
        """How well the data determine each coefficient, (p,): 1 - alpha times its variance.

        The mean over the components (Tipping 2001, for one component); 0 is irrelevant.
        """
        weights, _, covs = self.posterior(log_alpha)
        variances = np.diagonal(covs, axis1=1, axis2=2)
        return np.clip(weights @ (1 - np.exp(log_alpha) * variances), 0.0, 1.0)

    def derivatives(self, log_alpha: Array) -> Derivatives:
        """At log-precisions (p,)."""
        logs, means, covs = self._solved(log_alpha)
        alpha, weights = np.exp(log_alpha), softmax(logs)
        second_moments = np.diagonal(covs, axis1=1, axis2=2) + means**2
        gradients = 0.5 * (1 - alpha * second_moments)
        mixed = covs**2 + 2 * means[:, :, None] * means[:, None, :] * covs
        hessians = 0.5 * alpha[:, None] * alpha * mixed
        diagonal = np.arange(len(alpha))
        hessians[:, diagonal, diagonal] -= 0.5 * alpha * second_moments
        gradient = weights @ gradients
        spread = np.einsum("k,ki,kj->ij", weights, gradients - gradient, gradients - gradient)
        hessian = np.tensordot(weights, hessians, 1) + spread
        return Derivatives(float(logsumexp(logs)), gradient, hessian)

    def _solved(self, log_alpha: Array) -> tuple[Array, Array, Array]:
        """Log-evidence (..., K), means (..., K, p) and covariances of the components."""
        diagonal = np.exp(log_alpha)[..., None, :, None] * np.eye(log_alpha.shape[-1])
        covs = np.linalg.inv(self.precisions + diagonal)
        means = (covs @ self.shifts[..., None])[..., 0]
        quadratic = (means * self.shifts).sum(axis=-1)
        log_det = np.linalg.slogdet(covs)[1] + log_alpha.sum(axis=-1)[..., None]
        return self.log_scales + 0.5 * (log_det + quadratic), means, covs
