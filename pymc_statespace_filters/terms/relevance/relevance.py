"""The public function: automatic relevance determination from draws of the full model."""

import warnings
from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...compiler.native.compilation import COMPILATION
from ...errors import EvidenceWarning
from ...evidence.checks import check_convergence
from ...evidence.posterior import Posterior, check_overlap
from ...importance import MIN_EFFECTIVE, normalised
from ...progress import row_progress
from ...pymc_model.inspection import given_model
from ...pymc_model.posterior_draws import check_one_model, posterior_group, unconstrained_draws
from ...system.checks import check_random_seed
from .ard_evidence import ABSENT
from .chosen_terms import ChosenTerms, chosen_terms
from .optimum import largest_evidence, largest_without
from .table import Optimised, relevance_table
from .term_mixture import TermMixture, fit_terms
from .weighed import N_POINTS, TermDensity

MOST_FITTED = 4000  # draws

Array = NDArray[np.float64]


def relevance(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    names: str | Iterable[str] = (),
    *,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> pd.DataFrame:
    r"""Find the terms of an equation that the data need: automatic relevance determination.

    Each coefficient :math:`\phi_j` gets the prior :math:`N(0, 1 / \alpha_j)`, in place of that of
    the model, and the precisions :math:`\alpha` are those of the largest evidence. Where one of
    them goes to infinity the term is irrelevant. With a mixture of normals fitted to the draws the
    evidence is a closed form, which Newton's method maximises; the true density at points around
    the result then says how large the evidence is.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws of the model with all terms, from any sampler.
    model : pymc.Model, optional
        This model; by default that of the ``with`` block.
    names : str or iterable of str
        Coefficients that are zero where their term is absent: free variables, or elements of them
        such as ``"b[3]"`` or, by its coordinate, ``"b[z^3]"``, with independent fixed priors on
        both sides of zero, normal or flat at best. A variable of several elements stands for all of
        them.
    random_seed : int or numpy.random.Generator, optional
        Of the fit, of the points and of the noise of their likelihoods.
    progressbar : bool
        Whether to show a progress bar if the evaluations take more than two seconds.

    Returns
    -------
    pandas.DataFrame
        A row for each coefficient, index ``term``. Its display shows the first seven columns:

        ``relevance``
            :math:`1 - \alpha_j \operatorname{Var}(\phi_j)`, between 0, irrelevant, and 1: how much
            of what is known of the coefficient comes from the data.
        ``prior_sd``
            The standard deviation :math:`\alpha_j^{-1/2}` of the prior; zero if the term is
            irrelevant.
        ``mean``, ``sd``
            Of the posterior under these priors, by weighted points.
        ``gain``, ``gain_se``
            Log-evidence minus that without the term, the other priors optimised anew, and its
            standard error; zero for irrelevant terms, NaN if the points do not determine it.
        ``rivals``
            Irrelevant terms that become relevant where this one is left out.
        ``alpha``
            The precision of the prior.
        ``pareto_k``, ``n_effective``
            Tail and effective number of the weights of the points without the term.
        ``doubts``
            Why the gain is unknown; empty if it is known.

        Its attributes ``log_evidence`` and ``log_evidence_se`` are those under all priors together.
        ``inclusion`` is an argument for `select_terms`, with zero for the terms that are irrelevant
        and rivals of none.

    Raises
    ------
    ModelError
        If names are no coefficients with priors as above, if the draws are too few, do not
        vary or are those of `select_terms`.
    DataMismatchError
        If the draws belong to another model or other data.
    TypeError
        If no model is given, by argument or ``with`` block.

    Warns
    -----
    EvidenceWarning
        If the chains disagree, or if the mixture does not follow the posterior, so that an evidence
        has no error.

    See Also
    --------
    select_terms : Probabilities that terms are present.

    Notes
    -----
    This is nonlinear sparse Bayesian learning (Sandhu et al. 2021), with two differences: the
    relevance is the mean over the components of the mixture, and the evidence is computed again
    from the true density, by importance sampling.

    The optimum is a point. Of terms that can stand for each other it has one, perhaps not the true
    one: look at the rivals. A term without any effect has a finite prior in about a third of all
    data sets, with a small gain. A gain is not a Bayes factor for the term, as the prior was fitted
    to the same data; for one term whose estimate is t standard deviations from zero it is
    :math:`(t^2 - 1) / 2 - \log |t|` nats. `select_terms` averages over sub-models instead.

    References
    ----------
    R. Sandhu, M. Khalil, C. Pettit, D. Poirel and A. Sarkar (2021). Nonlinear sparse Bayesian
    learning for physics-based models. Journal of Computational Physics 426, 109728.

    M. E. Tipping (2001). Sparse Bayesian learning and the relevance vector machine. Journal of
    Machine Learning Research 1, 211-244.

    Examples
    --------
    A line through data of a line, with a candidate for its curvature:

    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> x = np.linspace(-1, 1, 20)
    >>> noise = 0.3 * np.random.default_rng(1).standard_normal(20)
    >>> with pm.Model() as model:
    ...     slope = pm.Normal("slope", 0, 3)
    ...     bend = pm.Normal("bend", 0, 3)
    ...     _ = pm.Normal("y", slope * x + bend * x**2, 0.3, observed=2 * x + noise)
    ...     idata = psf.sample_dram(random_seed=1, progressbar=False)
    >>> table = psf.relevance(idata, model, ["slope", "bend"], random_seed=2, progressbar=False)
    >>> table["relevance"].round(2).to_dict()
    {'slope': 1.0, 'bend': 0.0}
    """
    model, rng = given_model(model), check_random_seed(random_seed)
    posterior_group(idata)  # fails early, before anything is compiled
    check_one_model(idata, model)
    terms = chosen_terms(model, names)
    with COMPILATION:
        density = TermDensity(terms)
        draws = unconstrained_draws(idata, terms.model)
    with row_progress(density.calls, enabled=progressbar) as announce:
        announce("density of the draws", min(MOST_FITTED, draws.shape[0] * draws.shape[1]))
        mixture, doubts = _fitted(terms, density, draws, idata, rng)
        evidence = mixture.ard_evidence(terms)

        def at(log_alpha: Array) -> Optimised:
            proposals = mixture.proposals(evidence, log_alpha)
            sd = np.where(log_alpha < ABSENT, mixture.units * np.exp(-0.5 * log_alpha), 0.0)
            of_data = evidence.relevance(log_alpha)
            return Optimised(sd, of_data * (sd > 0), density.weigh(proposals, sd, rng))

        optimum = largest_evidence(evidence, rng)
        present = np.flatnonzero(optimum < ABSENT).tolist()
        announce("true density", N_POINTS * (1 + len(present)))
        best = at(optimum)
        without = {j: at(largest_without(evidence, optimum, j)) for j in present}
    table = relevance_table(terms.names, best, without)
    doubts += [f"the optimum: {one}" for one in best.weighed.doubts()]
    doubts += [f"without {name}: {one}" for name, one in table["doubts"].items() if one]
    if doubts:
        warnings.warn(f"relevance: {'; '.join(doubts)}", EvidenceWarning, stacklevel=2)
    return table


def _fitted(
    terms: ChosenTerms,
    density: TermDensity,
    draws: Array,
    idata: xr.DataTree,
    rng: np.random.Generator,
) -> tuple[TermMixture, list[str]]:
    """The mixture fitted to draws (chain, draw, k), and doubts about these."""
    kept = draws[:, :: -(-draws.shape[0] * draws.shape[1] // MOST_FITTED)]
    x = kept.reshape(-1, kept.shape[-1])
    log_density, log_prior = density.at_draws(x, rng)
    check_overlap(log_density)
    chains = Posterior(kept, log_density.reshape(kept.shape[:2]), lambda x, rng: log_density)
    # Only normal priors are divided out in closed form.
    log_weights = -log_prior[:, terms.prior_precision == 0].sum(axis=1)
    doubts = [*check_convergence(chains, idata), *_few(log_weights)]
    return fit_terms(x, log_weights, terms.columns, rng), doubts


def _few(log_weights: Array) -> Iterator[str]:
    """A doubt if few draws are left under flat priors."""
    n_effective = 1 / (normalised(log_weights) ** 2).sum()
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the draws are worth {n_effective:.0f} draws under flat priors of the coefficients: "
            "give these normal priors"
        )
