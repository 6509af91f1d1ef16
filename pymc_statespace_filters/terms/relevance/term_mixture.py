r"""Posterior draws as a mixture of normals: of the coefficients, and of all else given them.

Divided by its normal prior, each component is a normal function of the coefficients, the
likelihood: its precision is that of the component minus that of the prior. Sampling error can make
it negative where the data say nothing; such eigenvalues become zero, so that no likelihood grows
without bound.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import ModelError
from ...importance import normalised, systematic
from ...student_mixture import (
    NORMAL,
    WIDE_SCALE,
    WIDE_WEIGHT,
    StudentMixture,
    fit_mixture,
    likeliest_mixture,
    standardised,
)
from .ard_evidence import ABSENT, ArdEvidence
from .chosen_terms import ChosenTerms

MOST_COMPONENTS = 6
MIN_GAIN = 0.01  # nats per held-out draw, to accept a further component

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TermMixture:
    """A mixture of K normals of p coefficients, and of r other parameters given them.

    Attributes
    ----------
    weights : ndarray (K,)
    means, covs : ndarray (K, p), (K, p, p)
        Of the coefficients.
    centres, slopes, spreads : ndarray (K, r), (K, r, p), (K, r, r)
        Of the others: their means, their regression on the coefficients, and the covariance of what
        is left.
    units : ndarray (p,)
        Root mean squares of the coefficients.
    """

    weights: Array
    means: Array
    covs: Array
    centres: Array
    slopes: Array
    spreads: Array
    units: Array

    def ard_evidence(self, terms: ChosenTerms) -> ArdEvidence:
        """The likelihood of the coefficients in their units.

        The evidence is relative to that under the prior of the draws.
        """
        scale = self.units[:, None] * self.units
        prior = np.diag(terms.prior_precision * self.units**2)
        prior_mean, means = terms.prior_mean / self.units, self.means / self.units
        of_data = _without_negative(np.linalg.inv(self.covs / scale) - prior)
        precisions = of_data + prior
        shifts = (precisions @ means[..., None])[..., 0]
        known = prior.diagonal() > 0
        constant = 0.5 * (prior_mean @ prior @ prior_mean)
        constant -= 0.5 * np.log(prior.diagonal()[known]).sum()
        log_det = np.linalg.slogdet(precisions)[1]
        log_scales = np.log(self.weights) + constant
        log_scales += 0.5 * (log_det - (means * shifts).sum(axis=1))
        return ArdEvidence(log_scales, of_data, shifts - prior @ prior_mean)

    def proposals(self, evidence: ArdEvidence, log_alpha: Array) -> StudentMixture:
        """A density near the posterior under normal priors: of terms present, then of the others.

        Heavier in its tails than the mixture, with copies of the components that are wider.
        """
        weights, means, covs = evidence.posterior(log_alpha)
        present = np.flatnonzero(log_alpha < ABSENT)
        means, covs = means * self.units, covs * self.units[:, None] * self.units
        covs = covs[:, present[:, None], present]
        slopes = self.slopes[:, :, present]
        others = self.centres + (self.slopes @ (means - self.means)[..., None])[..., 0]
        mixed = slopes @ covs
        across = np.swapaxes(mixed, 1, 2)
        joint = np.block(
            [[covs, across], [mixed, self.spreads + mixed @ np.swapaxes(slopes, 1, 2)]]
        )
        chols = np.linalg.cholesky(joint)
        found = StudentMixture(weights, np.concatenate([means[:, present], others], axis=1), chols)
        return found.with_wide_parts({WIDE_SCALE: WIDE_WEIGHT})


def _without_negative(precisions: Array) -> Array:
    values, vectors = np.linalg.eigh(precisions)
    return np.asarray((vectors * np.maximum(values, 0)[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def fit_terms(
    draws: Array, log_weights: Array, columns: NDArray[np.int64], rng: np.random.Generator
) -> TermMixture:
    """Fit to draws (n, k) with log-weights (n,), whose `columns` (p,) are the coefficients.

    Raises
    ------
    ModelError
        If the draws do not vary in every direction.
    """
    if np.ptp(log_weights) > 0:
        draws = draws[systematic(normalised(log_weights), len(draws), rng)]
    fitted = standardised(draws)
    if fitted is None:
        raise ModelError(
            "the draws of idata must vary in every direction, got a singular covariance of "
            f"{len(draws)} draws"
        )
    mixture = _chosen(fitted.z, rng).affine(fitted.mean, fitted.chol)
    covs = mixture.chols @ np.swapaxes(mixture.chols, 1, 2)
    others = np.setdiff1d(np.arange(draws.shape[1]), columns)
    of_terms = covs[:, columns[:, None], columns]
    across = covs[:, others[:, None], columns]
    slopes = across @ np.linalg.inv(of_terms)
    return TermMixture(
        mixture.weights,
        mixture.means[:, columns],
        of_terms,
        mixture.means[:, others],
        slopes,
        covs[:, others[:, None], others] - slopes @ np.swapaxes(across, 1, 2),
        np.sqrt((draws[:, columns] ** 2).mean(axis=0)),
    )


def _chosen(z: Array, rng: np.random.Generator) -> StudentMixture:
    """The mixture of normals with which draws that it was not fitted to are most probable."""
    z = rng.permutation(z)
    numbers = range(1, MOST_COMPONENTS + 1)
    best = likeliest_mixture(z[::2], z[1::2], numbers, rng, least_gain=MIN_GAIN, degrees=NORMAL)
    return fit_mixture(z, best)
