"""What a user calls: one estimator, or several on the same draws and whether they agree."""

import warnings
from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr

from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence.agreement import Agreement, agreement_of
from pymc_statespace_filters.evidence.estimators import (
    Bridge,
    ChibJeliazkov,
    Estimator,
    Importance,
    Laplace,
    PriorMonteCarlo,
    TemperedSMC,
)
from pymc_statespace_filters.evidence.evidence import Evidence
from pymc_statespace_filters.evidence.runner import evidences_of

ESTIMATORS: Mapping[str, Estimator] = {
    "chib_jeliazkov": ChibJeliazkov(),
    "bridge": Bridge(),
    "warp_bridge": Bridge(warped=True),
    "importance": Importance(),
    "tempered_smc": TemperedSMC(),
    "prior_monte_carlo": PriorMonteCarlo(),
    "laplace": Laplace(),
}


def chib_jeliazkov(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    n_proposals: int | None = None,
    n_blocks: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> Evidence:
    """Estimate the evidence of a model from draws of its posterior (thesis, 3.3.2 and Eq. 3.44).

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws by any sampler (NUTS, nutpie, DRAM, ...), warm-up removed. If `model` has a
        noisy likelihood, ``sample_stats`` must hold ``lp`` or the noise seed of each draw, as DRAM
        leaves them.
    model : pymc.Model, optional
        The model that was sampled; by default that of the ``with`` block. Everything in it counts:
        priors, observed variables, Potentials.
    n_proposals : int, optional
        Evaluations of the log-density around a central point. By default so many that their error
        is a third of that of the draws, or that the whole is below 0.01 nats; but no more than
        there are draws, and at most 20 000. With several blocks, those in every mean, 5000 by
        default; in all they are about 3 n_blocks - 2 times as many.
    n_blocks : int, optional
        Blocks of neighbouring parameters whose ordinates are estimated one after the other. One by
        default; with ten parameters or more, and if one block promises an error above 0.1 nats,
        blocks of about ten.
    random_seed : int or numpy.random.Generator, optional
        For the proposals and the noise of their likelihoods.
    extend_inferencedata : bool
        Also store the result as the group ``evidence`` of `idata`.
    progressbar : bool
        Show one if the evaluations take more than two seconds.

    Returns
    -------
    Evidence
        Its `se` counts the autocorrelation of the draws and the proposals' own error. If the chains
        held one noise seed (``noise="held"``), this is the evidence under that seed and `se` lacks
        the error of the filter.

    Raises
    ------
    ModelError
        If an argument is wrong, a free variable is discrete, the draws are too few or do not vary,
        or chains of held noise have different seeds.
    DataMismatchError
        If the draws lack free variables of the model or belong to another model or to other data,
        or the estimates of a noisy likelihood cannot be found again.
    TypeError
        If no model is given, by argument or ``with`` block.

    Warns
    -----
    EvidenceWarning
        If the error or the number deserves doubt: few terms dominate a mean, the chains disagree, a
        prior is improper or not normalised, part of the posterior lies at the stability limit of
        Euler-Maruyama steps.

    Examples
    --------
    One parameter, three observations, and draws from the posterior that is known:

    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> normals = np.random.default_rng(1).standard_normal((4, 1000))
    >>> idata = az.from_dict({"posterior": {"mu": 4 / 13 + normals / np.sqrt(3.25)}})
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     evidence = psf.chib_jeliazkov(idata, random_seed=2)
    >>> abs(evidence.log_evidence - (-4.6154)) < 4 * evidence.se < 0.1
    True
    """
    found = evidences_of(
        idata,
        model,
        {"chib_jeliazkov": ChibJeliazkov(n_proposals, n_blocks)},
        random_seed=random_seed,
        extend_inferencedata=extend_inferencedata,
        progressbar=progressbar,
    )
    return found["chib_jeliazkov"]


class EvidenceEstimates(dict[str, Evidence]):
    """What `estimate_evidence` found, by estimator: a dictionary that is shown as a table.

    Attributes
    ----------
    agreement : Agreement
        True if the estimates agree.
    """

    @property
    def agreement(self) -> Agreement:
        """Whether the estimates agree, and the likely cause if they do not."""
        return agreement_of(self)

    def to_dataframe(self) -> pd.DataFrame:
        """Index ``estimator``; columns ``log_evidence``, ``se``, ``doubts``."""
        rows = {
            name: {"log_evidence": e.log_evidence, "se": e.se, "doubts": e.doubts}
            for name, e in self.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("estimator")

    def __repr__(self) -> str:
        # Doubts are sentences: in a column they would push the errors out of sight.
        table = self.to_dataframe().drop(columns="doubts").to_string()
        doubts = [f"{name}: {e.doubts}" for name, e in self.items() if e.doubts]
        return "\n".join([table, self._verdict(), *doubts])

    def _repr_html_(self) -> str:
        return f"{self.to_dataframe().to_html()}<p>{self._verdict()}</p>"

    def _verdict(self) -> str:
        judged = sum(np.isfinite(e.se) for e in self.values())
        if judged < 2:
            return "one estimate with an error: nothing to compare it with"
        if self.agreement:
            apart = self.agreement.difference
            return f"the estimates agree within their errors, {apart:.3f} nats apart at most"
        return f"the estimates disagree: {self.agreement.reading}"


def estimate_evidence(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    estimators: Iterable[str] = ("chib_jeliazkov", "bridge"),
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> EvidenceEstimates:
    """Estimate the evidence of a model in several ways, and see whether they agree.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws by any sampler, as for `chib_jeliazkov`.
    model : pymc.Model, optional
        The model that was sampled; by default that of the ``with`` block.
    estimators : iterable of str
        Any of "chib_jeliazkov", "bridge" (bridge sampling from a normal), "warp_bridge" (from a
        normal that is moved, scaled and mirrored, for skewed posteriors), "importance" (from a
        mixture of Student-t densities, for several modes), "tempered_smc" (from the prior, needs no
        draws), "prior_monte_carlo" (the mean likelihood of draws of the prior, for few parameters)
        and "laplace" (an approximation without error).
    random_seed : int or numpy.random.Generator, optional
        Gives each estimator a stream of its own, whatever the others are.
    extend_inferencedata : bool
        Also store the results in the group ``evidence`` of `idata`, dimension ``estimator``.
    progressbar : bool
        Show one if the evaluations take more than two seconds.

    Returns
    -------
    EvidenceEstimates
        A dictionary of name to `Evidence`, shown as a table. Its ``agreement`` is true if they
        agree, and has ``p_value``, ``difference`` (nats) and ``reading`` (the likely cause if they
        do not); ``to_dataframe()`` is the table.

    Raises
    ------
    ModelError
        If an estimator is unknown, or none can treat the model: "laplace" cannot with a noisy
        likelihood or a mode at the edge of the support, "tempered_smc" and "prior_monte_carlo" with
        a prior that cannot be drawn from. And as `chib_jeliazkov`.
    DataMismatchError, TypeError
        As `chib_jeliazkov`.

    Warns
    -----
    EvidenceWarning
        If an estimate is doubtful; if an estimator cannot treat the model, which is then missing
        from the result; or if the estimates disagree: p < 0.001 by Cochran's chi-square
        test, and by more than 0.05 nats. The warning names the likely cause.

    Examples
    --------
    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> normals = np.random.default_rng(1).standard_normal((4, 1000))
    >>> idata = az.from_dict({"posterior": {"mu": 4 / 13 + normals / np.sqrt(3.25)}})
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     found = psf.estimate_evidence(idata, random_seed=2)
    >>> bool(found.agreement)
    True
    """
    names = [estimators] if isinstance(estimators, str) else list(estimators or ())
    if not names or not set(names) <= set(ESTIMATORS):
        raise ModelError(
            f"estimators must name at least one of {list(ESTIMATORS)} and nothing else, got {names}"
        )
    found = EvidenceEstimates(
        evidences_of(
            idata,
            model,
            {name: ESTIMATORS[name] for name in names},
            random_seed=random_seed,
            extend_inferencedata=extend_inferencedata,
            progressbar=progressbar,
        )
    )
    if not found.agreement:
        warnings.warn(
            f"the estimates of the log-evidence disagree: {found.agreement.reading}",
            EvidenceWarning,
            stacklevel=2,
        )
    return found
