"""The result `Evidence`, and the DataTree group ``evidence`` in which it is stored."""

import math
from dataclasses import dataclass, fields
from html import escape
from typing import Any

import numpy as np
import xarray as xr

from ..errors import ModelError

GROUP = "evidence"
NOISE = ("none", "refreshed", "held")


@dataclass(frozen=True)
class Evidence:
    """The evidence p(D | M) of one model, with the quantities needed to compare models.

    Attributes
    ----------
    log_evidence : float
        Natural logarithm of the evidence (thesis, Eq. 3.5), priors normalised as the PyMC model
        states them: a Uniform prior contributes its volume.
    se : float
        Numerical standard error of `log_evidence`, in nats; NaN where the estimator has none.
    estimator : str
        Name of the estimator.
    n_parameters : int
        k, the number of free scalar variables: the dimension of the unconstrained parameter vector.
    n_observations : int
        J, the number of observations that are not entirely missing.
    max_log_likelihood : float
        Largest log-likelihood found by a search from the draws, for the information criteria. The
        likelihood is everything in the model except the priors of free variables, Potentials
        included. A noisy likelihood is averaged at the point found.
    data_fingerprint : str
        Hash of the observed values: equal for models of the same data, different otherwise.
    noise : {"none", "refreshed", "held"}
        "none": the likelihood is deterministic. "refreshed": the likelihood is estimated with fresh
        noise, and this is the evidence of its expectation. "held": the chains kept one noise seed,
        and this is the evidence under that seed; `se` excludes the error of the filter, which needs
        chains at several seeds.
    doubts : str
        Reasons why the error may be larger than `se`, or why the value depends on more than model
        and data; empty if there are none.
    log_volume : float
        Sum of the log widths of Uniform priors with constant bounds, over their scalars:
        ``log_evidence + log_volume`` is the integral with these prior densities replaced by one,
        the thesis's number (Eq. 3.7).
    uniform : str
        Names of the variables with such priors, separated by commas.
    improper : str
        Names of the free variables whose prior is improper, like ``pm.Flat``, or is not normalised,
        as under an ordering transform.
    approximate : bool, optional
        Whether a filter's likelihood is neither exact nor unbiased for its system, as that of an
        EKF for a nonlinear one: the evidence is then that of the filter's approximation. None if
        unknown.

    Raises
    ------
    ModelError
        If `log_evidence` or `log_volume` is not finite, `se` or a count is negative, or `noise` is
        none of the three.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> Evidence(-31.24, 0.02, "chib_jeliazkov", 3, 100, -24.1, "0c5f")
    Evidence(log_evidence=-31.240 ± 0.020, estimator='chib_jeliazkov', k=3, J=100)
    """

    log_evidence: float
    se: float
    estimator: str
    n_parameters: int
    n_observations: int
    max_log_likelihood: float
    data_fingerprint: str
    noise: str = "none"
    doubts: str = ""
    log_volume: float = 0.0
    uniform: str = ""
    improper: str = ""
    approximate: bool | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.log_evidence):
            raise ModelError(f"log_evidence must be a finite number, got {self.log_evidence!r}")
        if not (math.isnan(self.se) or 0 <= self.se < math.inf):
            raise ModelError(f"se must be a finite number >= 0 or NaN, got {self.se!r}")
        if self.n_parameters < 0 or self.n_observations < 0:
            raise ModelError(
                "n_parameters and n_observations must not be negative, "
                f"got {self.n_parameters!r} and {self.n_observations!r}"
            )
        if self.noise not in NOISE:
            raise ModelError(f"noise must be one of {NOISE}, got {self.noise!r}")
        if not math.isfinite(self.log_volume):
            raise ModelError(f"log_volume must be a finite number, got {self.log_volume!r}")

    @property
    def prior_note(self) -> str:
        """How the value depends on the supports of the priors; empty if it does not."""
        notes = []
        if self.improper:
            notes.append(
                f"The prior of {self.improper} is improper or not normalised: the evidence "
                "integrates the likelihood over the whole support of the prior's density, and "
                "depends on the unit of each of these parameters."
            )
        if self.uniform:
            notes.append(
                f"The Uniform priors of {self.uniform} have a log volume of "
                f"{self.log_volume:.2f}: halving the support of one scalar adds log 2 to the "
                "log-evidence as long as the posterior stays inside."
            )
        return " ".join(notes)

    def __repr__(self) -> str:
        noise = "" if self.noise == "none" else f", noise={self.noise!r}"
        improper = f", improper={self.improper!r}" if self.improper else ""
        return (
            f"Evidence(log_evidence={self.log_evidence:.3f} ± {self.se:.3f}, "
            f"estimator={self.estimator!r}, k={self.n_parameters}, "
            f"J={self.n_observations}{noise}{improper})"
        )

    def _repr_html_(self) -> str:
        return f"<code>{escape(repr(self))}</code>"


def store_evidence(idata: xr.DataTree, evidence: Evidence, settings: dict[str, float]) -> None:
    """Store `evidence` in the group of `idata`, replacing an earlier one of the same estimator.

    The group has the dimension ``estimator``. Each field becomes a variable, and so do the settings
    and diagnostics of the estimator.
    """
    record = {field.name: getattr(evidence, field.name) for field in fields(evidence)} | settings
    name = record.pop("estimator")
    # netCDF has no None, and a missing entry of a field becomes NaN too.
    record["approximate"] = np.nan if evidence.approximate is None else float(evidence.approximate)
    new = xr.Dataset(
        {key: ("estimator", [value]) for key, value in record.items()},
        coords={"estimator": [name]},
    )
    if GROUP in idata.children:
        old = idata[GROUP].to_dataset()
        others = [other for other in old["estimator"].values if other != name]
        if others:
            new = xr.concat([old.sel(estimator=others), new], dim="estimator", join="outer")
    idata[GROUP] = xr.DataTree(new)


def stored_evidences(idata: xr.DataTree, name: str) -> dict[str, Evidence]:
    """Read the evidences stored in `idata`, by estimator; a `ModelError` if there are none.

    ``name`` is that of `idata` in the message.
    """
    if GROUP not in idata.children:
        raise ModelError(
            f"{name!r} has no group {GROUP!r}: call estimate_evidence(idata, model) on it first; "
            f"its groups are {sorted(idata.children)}"
        )
    group = idata[GROUP].to_dataset()
    names = map(str, group["estimator"].values)
    return {one: Evidence(estimator=one, **_record(group, i)) for i, one in enumerate(names)}


def _record(group: xr.Dataset, row: int) -> dict[str, Any]:
    """The fields of one estimate, except its estimator."""
    names = [one.name for one in fields(Evidence) if one.name != "estimator"]
    record = {name: np.asarray(group[name].values[row]).item() for name in names}
    approximate = record["approximate"]
    record["approximate"] = None if math.isnan(approximate) else bool(approximate)
    return record
