"""The public function: which terms belong in the equation."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from ..compiler.native.compilation import COMPILATION
from ..errors import EvidenceWarning, warn
from ..parallel.shared_rows import by_first_rank
from ..progress import row_progress
from ..pymc_model.in_step import shared_by_ranks
from ..pymc_model.inspection import given_model
from ..pymc_model.posterior_draws import check_one_model, posterior_group
from ..sampling import sample
from ..system.checks import check_random_seed
from .candidates import read_candidates
from .doubts import check_distinct, check_finite, doubts, doubts_of_potentials
from .enumeration import estimate_all, probabilities, until_certain, with_lighter_tails
from .guidance import NO_GUIDE, checked_guide
from .inclusion import BETA_BINOMIAL, MOST_COUNTED, read_inclusion
from .maxima import Maxima
from .proposals import Guide
from .submodel_chains import MOST_MENDED, run_chains
from .submodel_density import SubmodelDensity
from .submodel_evidence import Sampler
from .terms_tree import as_datatree, averaged


@shared_by_ranks
def select_terms(
    model: pm.Model,
    absent: Mapping[Any, Any],
    *,
    idata: xr.DataTree | None = None,
    inclusion: Any = BETA_BINOMIAL,
    requires: Mapping[Any, Any] | None = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
    comm: Any = None,
) -> xr.DataTree:
    r"""Compute the probability of every term of an equation, from draws of the full model.

    The model has all candidate terms, with the priors that they have if they are there. A
    sub-model lacks some of them: their variables are held at the values at which the terms vanish,
    and its density is that of the full model there, over the priors of these variables.

    Parameters
    ----------
    model : pymc.Model
        The full model, with continuous free variables; with any likelihood, with noise or without.
    absent : mapping
        The candidates, and the values at which their terms vanish: a scalar variable ``"k3"``; an
        element by its position or by the coordinates that the model gives it, ``"b[3]"`` or
        ``"b[z^3]"``; ``"b"`` for each element of a vector; or a tuple of such names, with a tuple
        of values, for what comes and goes together: a spring and its gap, ``("k", "gap")`` with
        ``(0.0, 0.3)``. The gap has no use without the spring, so that any value of it will do.
    idata : xarray.DataTree, optional
        Posterior draws of the full model, from any sampler. They say where to look, and not what
        the result is. Default: those of `sample`. Where its chains mix slowly, `sample_smc` with
        1000 draws may take less time.
    inclusion : "beta-binomial", float or mapping
        Prior of the sub-models. ``"beta-binomial"``: each number of terms is as probable as any
        other, and so are all sets of one size. A number: the probability of each term,
        independently of the others; or such a number for each candidate, where 0 is always absent
        and 1 always present.
    requires : mapping, optional
        For a candidate another one, or a list of them, without which it is not considered:
        ``{"k3": "k1"}``. The prior is restricted to the sub-models that remain.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool
        Whether to show a progress bar if the evaluations take more than two seconds.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks among which the evaluations are divided, as in `sample_dram`; the result does not
        depend on their number. A rank whose ``idata`` is None gets that of the first, which makes
        the draws if it has none.

    Returns
    -------
    xarray.DataTree
        None on ranks that do not get it.

        ``terms`` : along ``term``, with the labels of ArviZ, the probability of ``inclusion``, its
        standard error ``inclusion_se``, ``prior_inclusion``, and ``median_model``, the terms of a
        probability above one half; ``pairs`` along ``term`` and ``term_other``, the probability
        that both are present.

        ``models`` : the sub-models along ``model``, most probable first, with what is ``present``
        along ``term``; ``probability`` with its error ``probability_se``, ``log_evidence`` with its
        error ``se``, ``prior``, and of the points behind it the number ``n_evaluations``, the
        effective number ``n_effective`` and the tail of their weights, ``pareto_k``. ``se`` is NaN
        for sub-models that the data exclude, whose few points leave the evidence unknown.

        ``widths`` : the probabilities of inclusion for slabs that are all wider or narrower by a
        factor, about the values at which the terms vanish; ``plot_prior_sensitivity`` draws it.
        NaN where the points do not determine it. With ever wider slabs every term loses its
        probability (Lindley's paradox): what a result needs is a slab that means something.

        ``posterior`` : draws averaged over the sub-models, with all variables of the full model.
        Where a draw lacks a term, its variables have the values of ``absent``. ``sample_stats`` has
        the sub-model of each draw, and the noise seed of its likelihood. The attributes ``filter``
        and ``exact`` are as of `sample_dram`: with a filter that approximates the likelihood, so do
        the probabilities.

    Raises
    ------
    ModelError
        If an argument is invalid: a candidate that is no free variable or has no density of its
        own, a value at which the likelihood is not finite or to which the density of the prior
        falls to zero, as that of a LogNormal does at zero, two candidates that switch off the same
        term.
    DataMismatchError
        If the draws belong to another model, or ranks differ in model, data or seed.
    ParallelError
        As `sample_dram`.

    Warns
    -----
    EvidenceWarning
        If sub-models that matter have few effective points or weights with a heavy tail, if the
        draws are not of this model's posterior and nothing better was found, if a Potential may be
        a part of a candidate's prior, or if chains visit a term more or less often than the
        sub-models that were met say.

    Notes
    -----
    The evidence of each sub-model is the mean of importance weights from a mixture that is fitted
    to draws of the full model and conditioned on the values of ``absent``, or fitted again to its
    own points. With an unbiased filter every point has fresh noise, so that the mean is exact, and
    the standard errors contain the noise.

    Of up to 12 candidates all sub-models are estimated. Of more, four chains of 1000 steps walk
    over the sub-models, adding, dropping and swapping terms. With estimates that are unbiased and
    made anew for each proposal their law is exactly the posterior (Andrieu and Roberts 2009):
    ``visits`` in ``terms``, with ``visits_se``, are the frequencies. ``inclusion`` has the smaller
    errors, but is relative to the sub-models that were met, which are those in ``models``. Its
    error contains what one chain has visited and no other has met.

    Where the data do not determine all parameters of the full model, its draws are no guide to the
    sub-models. If the likelihood has no noise, such chains then start with no terms, and the
    mixture of a sub-model comes from its own maxima, found by Newton's method from those of the
    sub-model that the chain comes from.

    A variable that only absent terms use has its prior in a sub-model, such as a scale of slabs.
    Where that is far from what the full model says of it, the points of the sub-model are worth
    little, which a warning says: a tuple in `absent` makes it a part of the term.

    References
    ----------
    C. Andrieu and G. O. Roberts (2009). The pseudo-marginal approach for efficient Monte Carlo
    computations. Annals of Statistics 37, 697-725.

    J. G. Scott and J. O. Berger (2010). Bayes and empirical-Bayes multiplicity adjustment in the
    variable-selection problem. Annals of Statistics 38, 2587-2619.

    M. M. Barbieri and J. O. Berger (2004). Optimal predictive model selection. Annals of Statistics
    32, 870-897.

    Examples
    --------
    Does the damping have a quadratic part?

    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> v = np.linspace(-1, 1, 9)
    >>> force = 0.8 * v + 0.1 * np.array([0.3, -0.4, 1.1, -0.2, 0.6, 0.1, -1.2, 0.5, -0.7])
    >>> with pm.Model() as full:
    ...     c1, c2 = pm.Normal("c1", 0, 1), pm.Normal("c2", 0, 1)
    ...     y = pm.Normal("y", c1 * v + c2 * abs(v) * v, 0.1, observed=force)
    >>> found = psf.select_terms(full, {"c1": 0.0, "c2": 0.0}, random_seed=1, progressbar=False)
    >>> found["terms"]["inclusion"].round(1).to_series().to_dict()
    {'c1': 1.0, 'c2': 0.2}
    """
    model = given_model(model)
    candidates = read_candidates(model, absent)
    prior = read_inclusion(candidates, inclusion, requires)
    rng = check_random_seed(random_seed)
    if idata is None:
        seed = int(rng.integers(2**63))
        idata = by_first_rank(
            lambda: sample(model=model, random_seed=seed, progressbar=progressbar)
        )
    assert idata is not None, "draws on another rank"
    like = posterior_group(idata)
    check_one_model(idata, model)
    with COMPILATION:
        density = SubmodelDensity(model, candidates)
        guide = Guide.of_draws(density, idata, rng)
        with row_progress(density.density.calls, enabled=progressbar) as announce:
            check_distinct(density, guide.draws, rng)
            sampler = Sampler(density, guide.base, rng)
            guide, full = checked_guide(guide, density, sampler, rng, announce)
            visits = maxima = None
            if prior.n_open <= MOST_COUNTED:
                sets = prior.all_sets()
                points = estimate_all(sets, candidates, prior, guide, sampler, rng, announce)
            else:
                if full.efficiency < NO_GUIDE and not sampler.is_noisy:
                    maxima = Maxima(density, guide, sampler, rng)
                visits = run_chains(prior, guide, sampler, rng, announce, maxima)
                check_finite(visits.points, candidates)
                sets, points = visits.sets, visits.points
                if maxima is not None:
                    points = with_lighter_tails(
                        points, sets, prior.log_weight(sets), sampler, rng, announce, MOST_MENDED
                    )
                points = until_certain(points, sets, prior.log_weight(sets), sampler, announce)
        found = probabilities(points, sets, prior.log_weight(sets))
        if visits is not None:
            found = replace(found, missed=visits.missed(found.inclusion))
        count = like.sizes["chain"] * like.sizes["draw"]
        drawn = averaged(points, found.of_models, count, rng)
        tree = as_datatree(found, points, prior.restriction(rng), visits, drawn, density, idata)
    reasons = [
        *doubts_of_potentials(model, candidates),
        *doubts(found, points, candidates, visits, full if maxima is None else None),
    ]
    for doubt in reasons:
        warn(f"probabilities of terms: {doubt}", EvidenceWarning)
    return tree
