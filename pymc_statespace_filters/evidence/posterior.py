"""The posterior as estimators see it: unconstrained draws, log-densities, the prior, and the data.

Log-densities on the unconstrained space include the Jacobians of the transforms.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import DataMismatchError, ModelError
from ..filters.outcomes import Failure, why_zero
from ..importance import LogMean, log_mean_of_draws, mcse
from ..pymc_model.aligned_axes import records_of_rows
from ..pymc_model.density import ModelDensity
from ..pymc_model.filter_estimates import failures_at
from ..pymc_model.inspection import scored_rows
from ..pymc_model.posterior_draws import check_one_model, populations_of, unconstrained_draws
from ..pymc_model.prior import ModelPrior
from ..pymc_model.random_variable import PanelRV

N_CHECKED = 16  # draws whose stored log-density is compared with a recomputed one
N_EXPLAINED = 100  # points of zero likelihood at which the reason is looked for
LEAST_POPULATIONS = 4  # two in each half, whose spread is its error
LEAST_SHARE = 0.02  # of the draws, for a population to count
LEAST_HALF = 0.25  # of the draws
STORED_NAMES = ("lp", "logp")  # of the log-density in sample_stats, in PyMC and in nutpie

Array = NDArray[np.float64]


class Prior(Protocol):
    """The prior of the free variables on the unconstrained space, Jacobians included."""

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k), shape (m,); normalised if the priors are."""

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, k); `ModelError` if the prior cannot be sampled."""


@dataclass(frozen=True)
class Posterior:
    """Draws of a posterior with their log-densities, and functions to evaluate further points.

    Attributes
    ----------
    draws : ndarray (chain, draw, k)
        Unconstrained.
    log_density : ndarray (chain, draw)
        Log prior + log likelihood + log Jacobian of each draw. With a noisy likelihood these are
        the estimates by which the chain accepted the draws; fresh ones cannot replace them.
    evaluate : callable
        ``evaluate(x, rng)`` returns the log-densities (m,) of points x (m, k), never NaN; a noisy
        likelihood takes fresh noise from `rng` for each point.
    is_noisy : bool
        Whether repeated evaluations at one point differ.
    failures : callable, optional
        ``failures(x)`` counts why the likelihood is zero at points x (m, k).
    prior : Prior, optional
        The likelihood is the log-density of `evaluate` minus that of the prior.
    population : ndarray of int (chain, draw), optional
        The population of each draw, if they are particles: see `are_populations`. The draws of one
        have common ancestors, so that only populations are independent.
    shared_seed : tuple of int, optional
        Seed of the points whose log-densities several estimators use. Without it each estimator
        evaluates points of its own.
    shared : dict
        These points; empty at first, and in every copy.
    """

    draws: Array
    log_density: Array
    evaluate: Callable[[Array, np.random.Generator], Array]
    is_noisy: bool = False
    prior: Prior | None = None
    failures: Callable[[Array], Counter[Failure]] | None = None
    population: NDArray[np.int64] | None = None
    shared_seed: tuple[int, ...] | None = None
    shared: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def required_prior(self) -> Prior:
        """The prior, for estimators that cannot do without it."""
        assert self.prior is not None, "a posterior without a prior"
        return self.prior

    def evaluate_factors(self, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Log prior and log-likelihood of points x (m, k), each of shape (m,).

        A noisy likelihood is estimated with fresh noise for each point.
        """
        log_prior = self.required_prior.log_density(x)
        return log_prior, log_likelihood_of(self.evaluate(x, rng), log_prior)

    def worst_disagreement(self, found: Iterable[str]) -> list[str]:
        """The worst of what chains disagree about, if they are chains; those that agree are ""."""
        if self.population is not None:
            return []
        return sorted({one for one in found if one})[-1:]

    def mcse(self, terms: Array) -> float:
        """Standard error of the mean of terms (chain, draw), one of each draw."""
        return mcse(terms, self.population)

    def ess(self, terms: Array) -> float:
        """How many independent draws the mean of terms (chain, draw) is worth, at least one."""
        if self.population is not None:
            error = self.mcse(terms)
            return max(1.0, float(terms.var()) / error**2) if error > 0 else float(terms.size)
        from arviz_stats import ess  # loads much: see `importance`

        return float(ess(terms, method="mean"))

    def log_mean(self, log_terms: Array) -> LogMean:
        """Log of the mean of positive terms (chain, draw), one of each draw, with its error."""
        return log_mean_of_draws(log_terms, self.population)

    def why_zero(self, x: Array) -> str:
        """Why the likelihood is zero at most of some prior draws x (m, k), and what to do."""
        x = x[:N_EXPLAINED]
        return why_zero(Counter() if self.failures is None else self.failures(x), len(x))

    def halves(self) -> tuple["Posterior", "Posterior"]:
        """Split every chain into its first and second half; of populations, half of these.

        Each half can be averaged, with an error of its own.

        Raises
        ------
        ModelError
            If fewer than four populations have a fiftieth of the draws or more, or one decides,
            so that either half has less than a quarter of the draws.
        """
        if self.population is not None:
            return self._halves_of_populations(self.population)
        return self._halves_of_chains()

    def halves_for_fit(self) -> tuple["Posterior", "Posterior"]:
        """Split every chain into its first and second half; of populations, every second draw.

        A fit to one half is compared with the other. Nothing is averaged, so that one population
        is enough.
        """
        if self.population is not None:
            return self.at(np.s_[:, ::2]), self.at(np.s_[:, 1::2])
        return self._halves_of_chains()

    def _halves_of_chains(self) -> tuple["Posterior", "Posterior"]:
        middle = self.draws.shape[1] // 2
        return self.at(np.s_[:, :middle]), self.at(np.s_[:, middle:])

    def _halves_of_populations(
        self, population: NDArray[np.int64]
    ) -> tuple["Posterior", "Posterior"]:
        """The populations dealt out in the order of their sizes, each half as one chain."""
        labels, sizes = np.unique(population, return_counts=True)
        order = labels[np.argsort(-sizes, kind="stable")]
        is_first = np.isin(population, [*order[::4], *order[3::4]])
        n_counting = int((sizes >= LEAST_SHARE * population.size).sum())
        share = min(is_first.mean(), 1 - is_first.mean())
        if n_counting < LEAST_POPULATIONS or share < LEAST_HALF:
            raise ModelError(
                f"the draws of idata must be of at least {LEAST_POPULATIONS} populations, none of "
                f"which decides alone, to be averaged, got {n_counting} with {LEAST_SHARE:.0%} of "
                f"the draws or more, and {sizes.max() / population.size:.0%} in the largest: use "
                'estimate_evidence with estimators="importance", or raise draws or populations of '
                "sample_smc"
            )
        first, second = (np.nonzero(mask) for mask in (is_first, ~is_first))
        return self.at(tuple(one[None] for one in first)), self.at(
            tuple(one[None] for one in second)
        )

    def thinned(self, most: int) -> "Posterior":
        """Thin every chain evenly, so that about `most` draws remain in all, or fewer."""
        return self.every(-(-self.log_density.size // most))

    def every(self, step: int) -> "Posterior":
        """One of so many draws of every chain."""
        return self.at(np.s_[:, ::step])

    def at(self, index: Any) -> "Posterior":
        """The draws at an index of the axes chain and draw."""
        population = None if self.population is None else self.population[index]
        return replace(
            self,
            draws=self.draws[index],
            log_density=self.log_density[index],
            population=population,
        )


def log_likelihood_of(log_density: Array, log_prior: Array) -> Array:
    """Log-density minus log prior; -inf wherever the log-density is -inf."""
    finite = np.isfinite(log_density)
    return np.subtract(log_density, log_prior, out=np.full_like(log_density, -np.inf), where=finite)


def check_overlap(log_density: Array) -> None:
    """Raise a `DataMismatchError` if the density of a model is zero at all proposals (m,)."""
    if np.isneginf(log_density).all():
        raise DataMismatchError(
            f"all {len(log_density)} proposals around the draws have zero density: idata belongs "
            "to another model or to other data"
        )


def build_posterior(idata: xr.DataTree, density: ModelDensity) -> tuple[Posterior, str]:
    """Combine the draws of `idata` with the compiled density of their model.

    ``sample_stats`` may have the log-density ``lp`` of each draw; it must have it, or the noise
    seeds ``<name>_seed``, if the noise was refreshed along the chain. Also returns the treatment of
    the noise: "none", "refreshed" or "held", as in `Evidence`.

    Raises
    ------
    ModelError, DataMismatchError
        As `check_one_model` and `unconstrained_draws`; and if stored and recomputed log-densities
        disagree.
    """
    check_one_model(idata, density.model)
    draws = unconstrained_draws(idata, density.model)
    stats = idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()
    lacking = [f"{name}_seed" for name in density.seed_names if f"{name}_seed" not in stats]
    stored = _stored_name(stats)
    if density.moved and stored is None:
        raise DataMismatchError(
            "sample_stats of idata must hold the log-density of the draws, because the chain moved "
            "its noise (correlation) and no seed reproduces it: sample all variables by one DRAM "
            "step, and keep the group sample_stats"
        )
    if lacking and stored is None:
        raise DataMismatchError(
            f"sample_stats of idata must hold the noise seeds of the draws ({lacking}) or their "
            "log-density, to recover the likelihood estimates of the chain: keep the group "
            "sample_stats that DRAM stores"
        )
    seeds = _stored_seeds(stats, density, draws.shape[:2])
    log_density = _stored_log_density(stats, density, draws, seeds)

    held = not density.moved and bool((seeds == seeds[:1, :1]).all())
    if not (held or density.moved) and (seeds == seeds[:, :1]).all():
        raise ModelError(
            "idata must hold chains of one noise seed if the seed was held, got "
            f"{len(np.unique(seeds[:, 0], axis=0))} seeds in {len(seeds)} chains: pass one chain "
            "at a time"
        )
    noise = "none" if not density.seed_names else "held" if held else "refreshed"

    def evaluate(x: Array, rng: np.random.Generator) -> Array:
        if held:
            return density.evaluate(x, np.broadcast_to(seeds[0, 0], (len(x), seeds.shape[-1])))
        size = (len(x), seeds.shape[-1])
        return density.evaluate(x, rng.integers(np.iinfo(np.int64).max, size=size))

    prior = ModelPrior(density.model)
    failures = partial(failures_at, density.model)
    facts = not held, prior, failures, populations_of(idata)
    return Posterior(draws, log_density, evaluate, *facts), noise


def reproducing_seeds(idata: xr.DataTree, density: ModelDensity) -> NDArray[np.int64] | None:
    """Seeds (chain, draw, n_seeds) that reproduce the estimates of the draws; None if none do."""
    stats = idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()
    lacking = any(f"{name}_seed" not in stats for name in density.seed_names)
    if lacking or density.moved or _has_seeds_of_records(stats, density):
        return None
    posterior = idata["posterior"]
    shape = posterior.sizes["chain"], posterior.sizes["draw"]
    return _stored_seeds(stats, density, shape)


def _stored_seeds(
    stats: xr.Dataset, density: ModelDensity, shape: tuple[int, int]
) -> NDArray[np.int64]:
    """Noise seeds of the draws, (chain, draw, n_seeds); the model's where none are stored."""
    columns = [
        _one_seed(stats[f"{name}_seed"].transpose("chain", "draw", ...).values)
        if f"{name}_seed" in stats
        else np.full(shape, seed)
        for name, seed in zip(density.seed_names, density.model_seeds, strict=True)
    ]
    return (
        np.stack(columns, axis=-1).astype(np.int64) if columns else np.empty((*shape, 0), np.int64)
    )


def _one_seed(seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """The seed of each draw, (chain, draw).

    The records of a panel that were moved one by one have seeds of their own. Where these differ
    the result is their sum, which tells whether any has changed.
    """
    if seeds.ndim == 2:
        return seeds
    is_one = (seeds == seeds[..., :1]).all(axis=-1)
    return np.where(is_one, seeds[..., 0], seeds.sum(axis=-1))


def _has_seeds_of_records(stats: xr.Dataset, density: ModelDensity) -> bool:
    """Whether the estimates of a draw have several seeds, which no one evaluation repeats."""
    names = [f"{name}_seed" for name in density.seed_names if f"{name}_seed" in stats]
    return any(
        (stats[name] != stats[name].isel({dim: 0})).any()
        for name in names
        for dim in set(stats[name].dims) - {"chain", "draw"}
    )


def _stored_name(stats: xr.Dataset) -> str | None:
    """Name of the joint log-density of the draws in `stats`, if there is one.

    Compound step methods store one column each, none of which is the joint log-density, and PyMC
    fills in zeros if the last of them stores none.
    """
    for name in STORED_NAMES:
        if name in stats and stats[name].ndim == 2 and stats[name].values.any():
            return name
    return None


def _stored_log_density(
    stats: xr.Dataset, density: ModelDensity, draws: Array, seeds: NDArray[np.int64]
) -> Array:
    """Log-densities of the draws (chain, draw): the stored ones, else recomputed."""
    flat_draws = draws.reshape(-1, draws.shape[-1])
    flat_seeds = seeds.reshape(len(flat_draws), -1)
    name = _stored_name(stats)
    if name is None:
        log_density = density.evaluate(flat_draws, flat_seeds)
        if impossible := int(np.isneginf(log_density).sum()):
            raise DataMismatchError(
                f"{impossible} of {len(flat_draws)} draws of idata have zero density under the "
                "model: they belong to another model or to other data"
            )
        return log_density.reshape(draws.shape[:2])

    stored = stats[name].transpose("chain", "draw").values.astype(np.float64)
    if density.moved or _has_seeds_of_records(stats, density):  # cannot be recomputed
        return stored
    checked = np.linspace(0, len(flat_draws) - 1, N_CHECKED).astype(int)
    recomputed = density.evaluate(flat_draws[checked], flat_seeds[checked])
    expected = stored.ravel()[checked]
    # The transform loses digits near a bound, so that a minority of the draws may differ.
    # PyMC 6.4 stores NumPyro's potential energy, which has the opposite sign, under the same name.
    agree = {
        sign: np.isclose(recomputed, sign * expected, rtol=1e-6, atol=1e-4) for sign in (1.0, -1.0)
    }
    for sign, agrees in agree.items():
        if agrees.mean() >= 0.5:
            return sign * stored
    worst = int(np.flatnonzero(~agree[1.0])[0])
    raise DataMismatchError(
        f"sample_stats[{name!r}] of idata must be the model's log-density, got "
        f"{expected[worst]:.6g} where the model gives {recomputed[worst]:.6g}: the draws "
        "belong to another model, other data or other settings"
    )


class Observed(NamedTuple):
    """Observed values of a variable, and whether an observation is a vector (the last axis).

    The first ``score_from`` rows, of each record in a panel, have no term in the log-density;
    ``is_scored`` are the others.
    """

    values: NDArray[np.float64]
    records: list[NDArray[np.float64]]  # the values, by record in a panel
    is_vector: bool
    score_from: int
    is_scored: Any

    @property
    def scored(self) -> NDArray[np.float64]:
        """The values that have a term."""
        return self.values[self.is_scored]


def observed_in(model: pm.Model) -> list[Observed]:
    """What every observed variable has for data."""
    found = []
    for rv in model.observed_RVs:
        values = np.asarray(model.rvs_to_values[rv].eval(mode="FAST_COMPILE"), dtype=np.float64)
        op = rv.owner.op
        is_vector, score_from = getattr(op, "ndim_supp", 0) > 0, getattr(op, "score_from", 0)
        records = _records(rv.owner, values)
        found.append(Observed(values, records, is_vector, score_from, scored_rows(rv.owner)))
    return found


def _records(node: Any, values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The values of each record of a panel; all together of any other variable."""
    if not isinstance(node.op, PanelRV):
        return [values]
    return np.split(values, np.flatnonzero(np.diff(records_of_rows(node.inputs[3]))) + 1)


def observation_count(model: pm.Model) -> int:
    """Count the observations J of a model that are scored and not entirely missing.

    A vector-valued observation (a row of a state-space or multivariate variable) counts once, like
    a scalar one; the counts of several observed variables are added.
    """
    return count_of(observed_in(model))


def count_of(observed: Sequence[Observed]) -> int:
    """Count the observations of some variables, as `observation_count`."""
    return sum(
        int((~np.isnan(one.scored).all(axis=-1) if one.is_vector else ~np.isnan(one.scored)).sum())
        for one in observed
    )


def scalar_count(model: pm.Model) -> int:
    """Count the observed scalars of a model that are scored and not missing."""
    return sum(int((~np.isnan(one.scored)).sum()) for one in observed_in(model))


def data_fingerprint(model: pm.Model) -> str:
    """Hash the observed values of a model.

    Returns
    -------
    str
        Hexadecimal SHA-256 of shapes, values, positions of missing values and numbers of rows that
        are not scored: reproducible across processes, and independent of the structure of the model
        and the names of its variables. The records of a panel count like variables, so that neither
        their order nor their labels matter. Axes of length one are ignored, so that a vector of J
        values equals a table of one column.
    """
    return fingerprint_of(observed_in(model))


def fingerprint_of(observed: Sequence[Observed]) -> str:
    """Hash the values of some variables, as `data_fingerprint`."""
    hashes = []
    for one in observed:
        unscored = f" scored from {one.score_from}" if one.score_from else ""
        for values in map(np.squeeze, one.records):
            canonical = np.where(np.isnan(values), np.nan, values + 0.0)  # one NaN, one zero
            content = repr(values.shape).encode() + canonical.astype("<f8").tobytes()
            hashes.append(hashlib.sha256(content + unscored.encode()).digest())
    return hashlib.sha256(b"".join(sorted(hashes))).hexdigest()
