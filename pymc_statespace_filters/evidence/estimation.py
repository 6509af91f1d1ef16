"""The public functions: one estimator, or several on the same draws and their agreement."""

from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass, replace
from html import escape
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr

from ..compiler.native.compilation import COMPILATION
from ..errors import EvidenceWarning, ModelError, warn
from ..filters.protocol import Filter
from ..former_names import FORMER_ESTIMATORS
from ..parallel.cpu_affinity import cores_set_to
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.inspection import given_model
from ..pymc_model.posterior_draws import are_populations
from ..system.checks import check_count, check_positive
from .agreement import Agreement, assess_agreement
from .estimators.bridge import Bridge
from .estimators.chib_jeliazkov import ChibJeliazkov
from .estimators.importance import Importance
from .estimators.protocol import Estimator
from .evidence import Evidence
from .runner import run_estimators

_BUILT_IN: tuple[Estimator, ...] = (ChibJeliazkov(), Bridge(), Importance())
DEFAULT = ("chib_jeliazkov", "bridge")
ESTIMATORS: Mapping[str, Estimator] = {estimator.name: estimator for estimator in _BUILT_IN}


@shared_by_ranks
def chib_jeliazkov(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    n_proposals: int | None = None,
    n_blocks: int | None = None,
    exchangeable: Any = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    cores: int | None = None,
    comm: Any = None,
) -> Evidence:
    """Estimate the evidence of a model from draws of its posterior (thesis, 3.3.2 and Eq. 3.44).

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws from any sampler (NUTS, nutpie, DRAM, ...), warm-up removed. If `model` has
        a noisy likelihood, ``sample_stats`` must hold the log-density ``lp`` or the noise seed of
        each draw; DRAM stores both.
    model : pymc.Model, optional
        The model that was sampled; by default that of the ``with`` block. The evidence includes
        all of it: priors, observed variables, Potentials.
    n_proposals : int, optional
        Number of log-density evaluations around a central point. The default is chosen such that
        their error is a third of that of the draws, or the total error is below 0.01 nats; it is
        at most the number of draws, and at most 20 000. With several blocks it is the number per
        mean, 5000 by default, and the total is about ``3 * n_blocks - 2`` times as large.
    n_blocks : int, optional
        Number of blocks of neighbouring parameters whose posterior ordinates are estimated in
        turn. The default is one block; with ten parameters or more, and a predicted error above
        0.1 nats for one block, it is blocks of about ten.
    exchangeable, random_seed, extend_inferencedata, progressbar, cores, comm
        As of `estimate_evidence`.

    Returns
    -------
    Evidence
        None on ranks that do not get it.
        Its `se` accounts for the autocorrelation of the draws and the error of the proposals. If
        the chains held one noise seed (``noise="held"``), this is the evidence under that seed, and
        `se` excludes the error of the filter.

    Raises
    ------
    ModelError
        If an argument is invalid, a free variable is discrete, the draws are too few, do not
        vary, are those of `select_terms` or `sample_smc`, or chains of held noise have different
        seeds.
    DataMismatchError
        If the draws lack free variables of the model, belong to another model or other data, or
        the likelihood estimates of the chain cannot be recovered.
    TypeError
        If no model is given, by argument or ``with`` block.

    Warns
    -----
    EvidenceWarning
        If the estimate may be unreliable: few terms dominate a mean, the chains disagree, a prior
        is improper or not normalised, labels may be exchanged and are not `exchangeable`, or part
        of the posterior lies at the stability limit of Euler-Maruyama steps.

    Examples
    --------
    One parameter, three observations, and exact draws from the posterior:

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
    with cores_set_to(_checked_cores(cores)), COMPILATION:
        found = run_estimators(
            idata,
            model,
            [ChibJeliazkov(n_proposals, n_blocks)],
            exchangeable=exchangeable,
            random_seed=random_seed,
            extend_inferencedata=extend_inferencedata,
            progressbar=progressbar,
        )
    return found["chib_jeliazkov"]


class EvidenceEstimates(dict[str, Evidence]):
    """Result of `estimate_evidence`: a dictionary by estimator, displayed as a table.

    Attributes
    ----------
    agreement : Agreement
        True if the estimates agree within their errors.
    """

    @property
    def agreement(self) -> Agreement:
        """Whether the estimates agree, with a diagnosis if they do not."""
        return assess_agreement(self)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with index ``estimator`` and columns ``log_evidence``, ``se``, ``doubts``."""
        rows = {
            name: {"log_evidence": e.log_evidence, "se": e.se, "doubts": e.doubts}
            for name, e in self.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("estimator")

    def __repr__(self) -> str:
        # Doubts are sentences: in a column they would push the errors off the screen.
        table = self.to_dataframe().drop(columns="doubts").to_string()
        return "\n".join([table, self._verdict(), *self._doubts()])

    def _repr_html_(self) -> str:
        table = self.to_dataframe().drop(columns="doubts").to_html()
        lines = [self._verdict(), *self._doubts()]
        return table + "".join(f"<p>{escape(line, quote=False)}</p>" for line in lines)

    def _doubts(self) -> list[str]:
        """What is doubtful, once, behind the names of the estimates that share it."""
        sharers: dict[str, list[str]] = {}
        for name, one in self.items():
            for doubt in filter(None, one.doubts.split("; ")):
                sharers.setdefault(doubt, []).append(name)
        shared: dict[str, list[str]] = {}
        for doubt, names in sharers.items():
            shared.setdefault(", ".join(names), []).append(doubt)
        return [f"{names}: {'; '.join(doubts)}" for names, doubts in shared.items()]

    def _verdict(self) -> str:
        if sum(np.isfinite(e.se) for e in self.values()) < 2:
            return "fewer than two estimates with a standard error: agreement not tested"
        if self.agreement:
            largest = self.agreement.difference
            return (
                f"the estimates agree within their errors (largest difference {largest:.3f} nats)"
            )
        return f"the estimates disagree: {self.agreement.diagnosis}"


@shared_by_ranks
def estimate_evidence(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    filter: Filter | None = None,
    estimators: str | Estimator | Iterable[str | Estimator] | None = None,
    target_se: float = 0.05,
    exchangeable: Any = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
    cores: int | None = None,
    comm: Any = None,
) -> EvidenceEstimates:
    """Estimate the evidence of a model by several estimators and test whether they agree.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws from any sampler, as for `chib_jeliazkov`.
    model : pymc.Model, optional
        The model that was sampled; by default that of the ``with`` block.
    filter : filter, optional
        Another filter than that of the draws, unbiased as `BootstrapPF` or exact: the evidence is
        then that of the model with this filter in every observed StateSpace variable. The draws
        only say where the posterior lies, and "importance" is the only estimator. By default the
        filter of the model.
    estimators : str, Estimator, or iterable of them, optional
        By default "chib_jeliazkov" and "bridge"; with draws of `sample_smc`, whose populations are
        few independent ones, or with `filter`, "importance", the only one that does not average
        the draws. Names among "chib_jeliazkov", "bridge" (bridge sampling to a normal distribution)
        and "importance" (importance sampling from a mixture of Student-t distributions, for several
        modes); or any `pymc_statespace_filters.evidence.estimators.Estimator`, built-in with other
        settings or your own.
    target_se : float
        Standard error, in nats, at which an estimator stops evaluating. The built-in ones begin
        with about 1000 evaluations and double them as long as this helps, up to at most 20 000. An
        `Estimator` with its own ``target_se`` or ``n_proposals`` keeps it. The part of the error
        that is due to the draws is reduced by more draws alone.
    exchangeable : str or list, optional
        The free variables with labels that may be exchanged, as those of K regimes:
        ``["mean", "P"]``. They are along one or more axes of a variable; a tuple in the list,
        ``[("low", "high")]``, has scalars of one label each, and a scalar is the share w of the
        first of two, of which the other one has 1 - w. All K! orders are then counted, whether the
        draws visit all of them, a transform keeps one, or the chains stay in one. ``()`` says that
        there are none. Without the argument, an evidence of labels that the density lets exchange
        is doubted.
    random_seed : int or numpy.random.Generator, optional
        Seed. Each estimator gets its own stream, independent of which others run.
    extend_inferencedata : bool
        Whether to store the results in the group ``evidence`` of `idata`, dimension ``estimator``.
    progressbar : bool
        Whether to show a progress bar if the evaluations take more than two seconds.
    cores : int, optional
        Number of threads, on which no number depends; by default one for each core that the process
        may use.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks among which the points are divided, as in `sample_dram`; the result does not depend
        on their number. A rank whose ``idata`` is None gets that of the first.

    Returns
    -------
    EvidenceEstimates
        None on ranks that do not get it.
        A dictionary of name to `Evidence`, displayed as a table. Its ``agreement`` is true if the
        estimates agree and has the attributes ``p_value``, ``difference`` (nats) and ``diagnosis``
        (the likely cause of a disagreement). ``to_dataframe()`` returns the table.

    Raises
    ------
    ModelError
        If an estimator is unknown or cannot treat the model, `target_se` is not positive, `filter`
        is biased or that of the model, or an estimator would average draws that only say where the
        posterior lies. Further as `chib_jeliazkov`.
    DataMismatchError, TypeError
        As `chib_jeliazkov`.

    Warns
    -----
    EvidenceWarning
        If the estimate that `compare_evidence` takes by default ("bridge", if it is made) may be
        unreliable, or its standard error stays above `target_se`, with the number of draws that
        would do or another remedy; doubts about the others are in the result. Or if the estimates
        disagree, with p < 0.001 by Cochran's chi-square test and by more than 0.05 nats. The
        warning states the likely cause.

    Notes
    -----
    "chib_jeliazkov" and "bridge" use the same evaluations of the normal distributions that they fit
    to the halves of the draws: the first to choose its proposals, the other in its estimate. No
    estimate depends on which others are made.

    With `filter`, the mean of prior times estimated likelihood over the density of the proposals is
    unbiased, and the noise of the estimates is part of the standard error (Tran, Scharth, Pitt and
    Kohn 2013). The proposals are fitted to at most 1000 draws, corrected as by `reweight`, which
    takes about 2000 evaluations, and up to 11 000 of a noisy filter. The filter is then checked as
    by `reweight`; what is found is among the ``doubts``. An estimate stored before by the same
    estimator is replaced.

    References
    ----------
    M.-N. Tran, M. Scharth, M. K. Pitt and R. Kohn (2013). Importance sampling squared for Bayesian
    inference in latent variable models. arXiv:1309.3339.

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
    model = given_model(model)
    if estimators is None:
        is_fit_enough = filter is not None or are_populations(idata)
        estimators = "importance" if is_fit_enough else DEFAULT
    selected = _select_estimators(estimators, check_positive("target_se", target_se))
    with cores_set_to(_checked_cores(cores)), COMPILATION:
        estimates = run_estimators(
            idata,
            model,
            selected,
            filter=filter,
            exchangeable=exchangeable,
            random_seed=random_seed,
            extend_inferencedata=extend_inferencedata,
            progressbar=progressbar,
        )
    found = EvidenceEstimates(estimates)
    if not found.agreement:
        warn(
            f"the estimates of the log-evidence disagree: {found.agreement.diagnosis}",
            EvidenceWarning,
        )
    return found


def _checked_cores(cores: int | None) -> int | None:
    return None if cores is None else check_count("cores", cores, 1)


def _select_estimators(
    given: str | Estimator | Iterable[str | Estimator], target_se: float
) -> list[Estimator]:
    """Look up names, check that the estimators are valid and differ in name, and set targets."""
    if isinstance(given, str | Estimator) or not isinstance(given, Iterable):
        given = [given]
    found: dict[str, Estimator] = {}
    for entry in given:
        if isinstance(entry, str) and entry in FORMER_ESTIMATORS:
            raise ModelError(f"the estimator {entry!r} {FORMER_ESTIMATORS[entry]}")
        estimator = ESTIMATORS.get(entry) if isinstance(entry, str) else entry
        if not isinstance(estimator, Estimator):
            raise ModelError(
                f"estimators must be names among {list(ESTIMATORS)} or Estimator objects, "
                f"got {entry!r}"
            )
        if found.setdefault(estimator.name, estimator) is not estimator:
            raise ModelError(
                f"estimators must have different names, got {estimator.name!r} more than once"
            )
    if not found:
        raise ModelError(f"estimators must have at least one of {list(ESTIMATORS)}, got {given!r}")
    return [_with_target(estimator, target_se) for estimator in found.values()]


def _with_target(estimator: Estimator, target_se: float) -> Estimator:
    """The estimator with a target, if it is a dataclass that can have one and has none."""
    if is_dataclass(estimator) and getattr(estimator, "target_se", target_se) is None:
        return replace(estimator, target_se=target_se)
    return estimator
