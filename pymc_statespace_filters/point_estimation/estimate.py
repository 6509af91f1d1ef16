"""The result `MaximumLikelihoodEstimate`, and the maximum that a search returns."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..tables import WIDTH, wrapped

LEVEL, INCREASING, EDGE, HIDDEN, STEPPED = "level", "increasing", "edge", "hidden", "stepped"

Array = NDArray[np.float64]


class Lost(NamedTuple):
    """A direction along which the maximum has no curvature."""

    direction: Array  # (k,), some posterior standard deviations long
    kind: str  # LEVEL, INCREASING, EDGE (of the support), HIDDEN (by noise) or STEPPED
    interval: tuple[Array, ...] = ()  # points (k,) at its ends, of a parameter that is stepped


class Peak(NamedTuple):
    """The largest log-likelihood found, its point, and the curvature there.

    The covariance of the estimate is ``basis @ basis.T``, without the lost directions.
    """

    point: Array  # (k,)
    value: float
    value_se: float
    basis: Array  # (k, r)
    lost: tuple[Lost, ...]
    hessian: Array  # (k, k); NaN for parameters at the edge of the support
    simulation_cov: Array  # (k, k), of the point, from the noise of the likelihood
    notes: tuple[str, ...]
    rivals: tuple[
        tuple[Array, float], ...
    ] = ()  # points and values of other, nearly as high maxima


def unconstrained_hessian(scale: Array, hessian: Array) -> Array:
    """Hessian (k, k) from that in coordinates z of x = scale z, scale (k, r).

    Rows of zeros in `scale` belong to parameters that were held; their second derivatives are NaN.
    """
    moved = scale.any(axis=1)
    found = np.full((len(scale), len(scale)), np.nan)
    if moved.any():
        inverse = np.linalg.inv(scale[moved])
        found[np.ix_(moved, moved)] = inverse.T @ hessian @ inverse
    return found


@dataclass(frozen=True, eq=False)
class MaximumLikelihoodEstimate:
    """A maximum of the likelihood with standard errors, as `maximum_likelihood` finds it.

    Attributes
    ----------
    estimate : dict of str to ndarray
        The free variables by name, in the model's units and shapes. It can be an entry of
        ``initvals`` for `sample_dram` and ``pm.sample``.
    log_likelihood : float
        The natural logarithm of everything in the model except the priors of the free variables,
        Potentials included. If the likelihood is a random estimate, the logarithm of the mean of
        200 fresh ones.
    log_likelihood_se : float
        Its standard error due to the noise of the likelihood; 0 if the likelihood is deterministic.
    standard_errors : dict of str to ndarray
        Of `estimate`, from the curvature of the log-likelihood (the observed information), in the
        same units and shapes. NaN for the scalars in `reasons`.
    reasons : dict of str to str
        Why a scalar of a free variable has no standard error, by its label.
    simulation_errors : dict of str to ndarray
        Standard deviations by which the noise of the likelihood displaces `estimate`; 0 if it is
        deterministic. Otherwise NaN for the scalars in `reasons`, and for all where the notes say
        that the maximum may not have been found. `standard_errors` do not include them.
    covariance : pandas.DataFrame
        Covariance of the estimate in the model's units, by the labels of all scalars, variable
        after variable, flattened in C order. Its diagonal are the squares of `standard_errors`.
    unconstrained : ndarray (k,)
        The estimate on the unconstrained space: the value variables in the order of
        ``model.free_RVs``, each flattened in C order.
    hessian : ndarray (k, k)
        Second derivatives of the log-likelihood at `unconstrained`, in its order. NaN for
        parameters at the edge of a support without a transform.
    notes : tuple of str
        What limits the accuracy; empty if nothing does.
    n_evaluations : int
        Of the likelihood, in all.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> from pymc_statespace_filters.point_estimation import MaximumLikelihoodEstimate
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 100)
    ...     y = pm.Normal("y", mu, 0.2, observed=[1.2, 1.1, 1.3, 1.2])
    ...     found = psf.maximum_likelihood(random_seed=1)
    >>> isinstance(found, MaximumLikelihoodEstimate)
    True
    >>> found.covariance.round(6)
            mu
    mu    0.01
    """

    estimate: Mapping[str, np.ndarray]
    log_likelihood: float
    log_likelihood_se: float
    standard_errors: Mapping[str, np.ndarray]
    reasons: Mapping[str, str]
    simulation_errors: Mapping[str, np.ndarray]
    covariance: pd.DataFrame
    unconstrained: np.ndarray
    hessian: np.ndarray
    notes: tuple[str, ...]
    n_evaluations: int

    def summary(self) -> pd.DataFrame:
        """A row for each scalar: estimate, its errors, and why there is no standard error.

        Returns
        -------
        pandas.DataFrame
            Index ``parameter``; columns ``estimate``, ``standard_error``, ``simulation_error`` (if
            the likelihood is noisy) and ``reason``.
        """
        columns = {"estimate": self.estimate, "standard_error": self.standard_errors}
        if self.log_likelihood_se > 0:
            columns["simulation_error"] = self.simulation_errors
        labels = self.covariance.index
        table = pd.DataFrame(
            {name: flattened(values) for name, values in columns.items()},
            index=pd.Index(labels, name="parameter"),
        )
        return table.assign(reason=[self.reasons.get(label, "") for label in labels])

    def _headline(self) -> str:
        error = f" ± {self.log_likelihood_se:.2g}" if self.log_likelihood_se > 0 else ""
        return f"Maximum likelihood: log-likelihood {self.log_likelihood:.4f}{error}"

    def _sentences(self) -> list[str]:
        """Why there are no standard errors, and the notes."""
        reasons = [f"No standard error of {name}: {why}." for name, why in self.reasons.items()]
        return [*reasons, *(f"Note: {note}." for note in self.notes)]

    def __repr__(self) -> str:
        table = self.summary().drop(columns="reason").to_string(line_width=WIDTH)
        return "\n".join([self._headline(), table, *wrapped(self._sentences())])

    def _repr_html_(self) -> str:
        sentences = "".join(f"<p>{escape(text)}</p>" for text in self._sentences())
        table = self.summary().drop(columns="reason").to_html()
        return f"<p>{self._headline()}</p>{table}{sentences}"


def flattened(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """All scalars of named arrays, (n,): array after array, in C order."""
    return np.concatenate([np.ravel(value) for value in values.values()]).astype(np.float64)
