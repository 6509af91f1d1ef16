"""What the chains of a model have found: the DataTree, the report and the warnings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning, WarningType, log_warnings
from xarray import DataTree

from ...parallel.signals import is_interrupted, unless_interrupted
from ...pymc_model.elements import element_names
from ...pymc_model.inspection import filters_used
from ...pymc_model.posterior_draws import STATES
from ..kernel.state import ChainState, Draws, side_generator
from ..output.convergence import Convergence
from ..output.datatree import to_datatree
from ..output.filter_check import FilterCheck, check_filters, warn_of_filters
from ..output.likelihood_variance import TOO_NOISY, spread_at_highest_draw
from ..output.remedies import ways_to_mix
from ..output.report import (
    ENOUGH_PER_CHAIN,
    below_known_warning,
    closing_report,
    few_draws_warning,
    left_out_warnings,
    mixing_warning,
    until_ess_warning,
)
from ..output.sample_stats import stat_dims, whole_chain
from ..output.step_check import step_warnings
from ..output.unvisited import unvisited_warnings
from ..output.warnings import LOWER, STANDSTILL, PhaseStatistics, below_known, chain_warnings
from ..target.record_target import RecordTarget
from ..target.target import Target
from .continuation import stored_states
from .record_chain import chain_of
from .request import SamplingRequest
from .stopping import ENOUGH, Length, is_enough, remedy_of, shows


@dataclass(frozen=True)
class ModelResult:
    """The chains of a model at their end.

    Attributes
    ----------
    results : list of (Draws, ChainState)
        Of each chain; empty once the DataTree is made.
    length, n_iterations
        Draws that chains were to have after the warm-up, and iterations with the warm-up.
    is_complete : bool
        Whether all chains have made these.
    measures_noise : bool
        Whether the noise of the likelihood is to be measured.
    seconds : float
        That sampling took.
    level : float
        The median log-density of the points of the search for starts, -inf without one.
    is_noisy : bool
        Whether a warning has said that the likelihood is too noisy there.
    convergence : Convergence, optional
        The diagnostics, if they were asked for.
    said : callable
        A message with the name of the model, if there are several.
    """

    model: Model
    request: SamplingRequest
    target: Target | RecordTarget
    results: list[tuple[Draws, ChainState]]
    length: Length
    n_iterations: int
    is_complete: bool
    measures_noise: bool
    seconds: float
    level: float
    is_noisy: bool
    convergence: Convergence | None
    said: Callable[[str], str]

    def to_datatree(self, *, check_convergence: bool, report_level: str) -> DataTree:
        """Make the DataTree, log warnings and a report; the results are released one by one."""
        target, request, results = self.target, self.request, self.results
        report, mixing = self._closing_messages(check_convergence)
        closing = left_out_warnings([len(d.positions) for d, _ in results], request.n_skipped)
        states = self._stored_states()
        warnings = chain_warnings(target, results, request.tune, self.length.thin)
        unknown: tuple[dict[str, float], list[SamplerWarning]] = {}, []
        attrs, noise_warnings = unless_interrupted(self._measure_noise, unknown)
        unreached = self._unreached_warnings([draws for draws, _ in results])
        key = results[0][1].key
        chains = []
        while results:
            chains.append(whole_chain(target, *results.pop(0), request.tune, self.length.thin))
        tree = to_datatree(
            self.model,
            target.raveled,
            chains,
            tune=request.tune,
            keep_warmup=request.keeps_warmup,
            sampling_time=self.seconds,
            stat_dims=stat_dims(target),
        )
        tree.attrs |= {
            **filters_used(self.model),
            "exact": int(target.exact),
            "refresh_noise": int(request.settings.refresh_noise),
            "correlation": request.settings.correlation or 0.0,
            "iterations_per_draw": self.length.thin,
            **attrs,
        }
        if states is not None:
            tree[STATES] = states
        check = FilterCheck()
        if check_convergence and "posterior" in tree:
            noise_warnings += unless_interrupted(lambda: self._unvisited_warnings(tree, key), [])
            noise_warnings += unless_interrupted(lambda: step_warnings(tree, self.model), [])
            check = unless_interrupted(lambda: self._check_filters(tree, key), check)
        noise_warnings += unreached
        if not unreached and warnings.keys().isdisjoint({STANDSTILL, LOWER}):  # which explain it
            noise_warnings += mixing
        said = [*warnings.values(), *noise_warnings, *closing]
        if not said and not check.warned and check_convergence and not is_interrupted():
            report += " No problems found."
        said += [SamplerWarning(WarningType.CONVERGENCE, report, report_level)] if report else []
        said += check.messages(report_level)
        log_warnings([replace(w, message=self.said(w.message)) for w in said])
        warn_of_filters([self.said(text) for text in check.warned])
        return tree

    def _stored_states(self) -> DataTree | None:
        """The states from which complete chains can go on."""
        request, former = self.request, self.request.former
        if not self.is_complete or self.n_iterations <= request.tune:
            return None
        return stored_states(
            self.model,
            [state for _, state in self.results],
            iterations=self.n_iterations + (0 if former is None else former.iterations),
            draws=self.length.draws + (0 if former is None else len(former.positions[0])),
            thin=self.length.thin,
            settings=request.settings,
        )

    def _unvisited_warnings(self, tree: DataTree, key: np.ndarray) -> list[SamplerWarning]:
        """Warn of what the chains have missed of the posterior."""
        prior, rng = self.target.prior_draws, side_generator(key, 3)
        return unvisited_warnings(tree, self.model, prior, self.seconds, rng)

    def _check_filters(self, tree: DataTree, key: np.ndarray) -> FilterCheck:
        """Compare the filters with unbiased ones at some draws."""
        rng = side_generator(key, 2)
        return check_filters(tree, self.model, self.n_iterations, self.seconds, rng)

    def _closing_messages(self, check_convergence: bool) -> tuple[str, list[SamplerWarning]]:
        """The report, empty without draws, and a warning if the chains have not mixed."""
        request, names = self.request, element_names(self.model, self.target.raveled.variables)
        statistics = {
            i: PhaseStatistics.from_draws(
                of_chain, request.tune, len(of_chain.positions), self.length.thin
            )
            for i, (of_chain, _) in enumerate(self.results)
            if len(of_chain.positions) > request.tune
        }
        if not statistics:
            return "", []
        report = closing_report(statistics, request.tune, self.convergence, names, self.length.thin)
        return report, self._mixing_warnings(check_convergence, names)

    def _mixing_warnings(
        self, check_convergence: bool, names: Sequence[str]
    ) -> list[SamplerWarning]:
        """Warn of chains that ended too early, or have not mixed."""
        request, n, found = self.request, self.length.n_iterations, self.convergence
        positions = {
            i: draws.positions[request.tune :] for i, (draws, _) in enumerate(self.results)
        }
        until_ess, draws = request.until_ess, np.concatenate(request.with_former(positions))
        ways = partial(ways_to_mix, self.model, names, draws)
        if until_ess is not None and self.is_complete and not is_enough(request, found):
            slowest = names[0] if found is None else names[int(found.rhat.argmax())]
            remedy = remedy_of(request, self.length, found, self.seconds, ways(slowest))
            return [until_ess_warning(until_ess, n, self.seconds, found, names, remedy)]
        if not check_convergence:
            return []
        enough = float(ENOUGH_PER_CHAIN * request.chains)
        if found is not None and not shows(request, ENOUGH) and not found.reaches(enough):
            return [few_draws_warning(found, names, request.chains * request.draws)]
        warning = mixing_warning(found, names, enough, n, self.seconds, ways)
        return [] if warning is None else [warning]

    def _unreached_warnings(self, chains: Sequence[Draws]) -> list[SamplerWarning]:
        """Warn if all chains stayed far below the points that the search for starts has found.

        An estimate may be far too high by chance, so that this says nothing of one with noise.
        """
        nats = below_known(self.level, chains, self.request.tune)
        return [] if nats is None or self.target.seed_names else [below_known_warning(nats)]

    def _measure_noise(self) -> tuple[dict[str, float], list[SamplerWarning]]:
        """Measure the likelihood's noise after a complete run: an attribute, and warnings."""
        request, target, results = self.request, self.target, self.results
        lengths = {len(draws.positions) for draws, _ in results}
        if not self.measures_noise or lengths != {request.tune + self.length.draws}:
            return {}, []
        keys = [state.key for _, state in results]
        spread, warning = spread_at_highest_draw(
            [draws for draws, _ in results],
            request.tune if request.draws else 0,
            chain_of(target, keys[0], 0, 0).seed_spread,
            keys,
            target,
        )
        is_said = self.is_noisy and TOO_NOISY < spread.variance < np.inf
        warnings = [] if warning is None or is_said else [warning]
        return {"log_likelihood_variance": spread.variance}, warnings
