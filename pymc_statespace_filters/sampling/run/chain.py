"""A Markov chain that moves all parameters together."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..kernel.adaptation_state import pack, packed_size, start_adaptation
from ..kernel.independence import no_mixture
from ..kernel.state import (
    N_COUNTS,
    ChainState,
    Draws,
    Evaluation,
    PhaseSettings,
    RandomBlock,
    draw_seeds,
)
from ..kernel.transition import advance
from ..output.likelihood_variance import SeedSpread, seed_spread
from ..target.initial_points import EvaluatedPoint, best_initial_point
from ..target.target import Target
from .chain_arrays import ChainArrays
from .thinned_draws import Thinning


class Chain(ChainArrays):
    """A Markov chain of a prepared target, which keeps ``n_rows`` draws.

    ``key`` (2,) is that of its random numbers, ``n_covs`` the number of first iterations whose
    proposal covariance is kept, and ``proposal_cov`` (d, d) that of the first proposals.
    """

    _target: Target

    def __init__(
        self,
        target: Target,
        key: np.ndarray,
        n_rows: int,
        n_covs: int,
        proposal_cov: np.ndarray | None = None,
        thinning: Thinning | None = None,
    ):
        self._density = target.density.bind()
        self._screen = None if target.screen is None else target.screen.bind()
        dim, n_noisy = target.raveled.dim, len(target.seed_names)
        adaptation = np.empty(packed_size(dim))
        first_cov = target.first_cov if proposal_cov is None else proposal_cov
        pack(start_adaptation(first_cov), adaptation)
        state = ChainState(
            np.empty(dim),
            np.zeros(n_noisy, dtype=np.int64),
            np.zeros(3),
            adaptation,
            no_mixture(dim),
            self._density.carried,
            np.array(key),
        )
        covs = np.empty((n_covs, dim, dim))
        super().__init__(target, state, n_rows, N_COUNTS, covs, thinning)

    @property
    def others(self) -> list[np.ndarray]:
        """Last values of the variables that other step methods move."""
        return self._density.others

    def start(
        self,
        candidates: Sequence[np.ndarray],
        others: Sequence[np.ndarray],
        rng: np.random.Generator,
    ) -> tuple[int, ...]:
        """Move to the best of the candidates, each evaluated with new noise.

        The last candidate is the point given by the user or the model; ``others`` are the values of
        variables that other step methods move. Returns 0 or the failure code of each evaluation.
        Raises `StopRequested` if a stop is requested meanwhile, and what the model raised.
        """
        self._density.correlation[...] = 0.0

        def evaluate(candidate: np.ndarray) -> EvaluatedPoint:
            self._check_pause()
            seeds = draw_seeds(rng, self.state.seeds.shape)
            if not self._target.settings.refresh_noise:
                seeds = self._target.fixed_seeds
            log_screen, failure = self._evaluate_screen(candidate, others, seeds)
            if log_screen == -np.inf:  # no move of the screen would ever leave this point
                return EvaluatedPoint(candidate, seeds, -np.inf, failure)
            value = self._density(candidate, others, seeds)
            return EvaluatedPoint(candidate, seeds, *value, log_screen)

        start, failures = best_initial_point(candidates, evaluate)
        if self.state.carried.size:  # later candidates have overwritten the noise of this one
            self._density(start.position, others, start.seeds)
        self._set_current(start)
        return failures

    def seed_spread(self, position: np.ndarray, seeds: np.ndarray) -> SeedSpread:
        """Measure the spread of estimates at a point over seeds, shape (R, noisy); as `start`."""

        def evaluate(*arguments: Any) -> Evaluation:
            self._check_pause()
            return self._density(*arguments)

        self._density.correlation[...] = 0.0
        spread = seed_spread(evaluate, position, (), seeds)
        self._restore_correlation()
        return spread

    def evaluate_again(self, others: Sequence[np.ndarray]) -> int:
        """Evaluate the current point and noise after other variables moved; its failure code.

        If the screen's log-density is minus infinity there, no move is accepted until they move.
        """
        self._density.correlation[...] = 1.0
        position, seeds = self.state.position.copy(), self.state.seeds.copy()
        log_screen, _ = self._evaluate_screen(position, others, seeds)
        value = self._density(position, others, seeds)
        self._set_current(EvaluatedPoint(position, seeds, *value, log_screen))
        return value.failure

    def restore(self, draws: dict[str, np.ndarray], state: dict[str, np.ndarray]) -> None:
        """Continue from the concatenated snapshots of a checkpoint."""
        super().restore(draws, state)
        self._restore_correlation()

    def _iterate(
        self,
        settings: PhaseSettings,
        random: RandomBlock,
        first: int,
        draws: Draws,
        row: int,
        n: int,
    ) -> int:
        target = self._density.native
        screen = target if self._screen is None else self._screen.native
        state, control = self.state, self.control
        return advance(settings, target, screen, state, random, first, draws, row, n, control)

    def _raise_error(self) -> None:
        for density in filter(None, (self._screen, self._density)):
            density.raise_error()

    def _evaluate_screen(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: np.ndarray
    ) -> tuple[float, int]:
        """Log-density of the screen, 0 without one, and its failure code."""
        if self._screen is None:
            return 0.0, 0
        value = self._screen(position, others, seeds)
        return value.log_density, value.failure

    def _set_current(self, point: EvaluatedPoint) -> None:
        """Take the point just evaluated, and its noise, as the current state."""
        state = self.state
        state.position[:], state.seeds[:] = point.position, point.seeds
        state.numbers[:] = point.log_density, point.n_effective, point.log_screen
        if state.carried.size:
            state.carried[:] = self._density.native.call.out[-state.carried.size :]
        self._restore_correlation()

    def _restore_correlation(self) -> None:
        """Set the correlation of the next proposals' noise to that of the settings."""
        if self._target.settings.correlation is not None:
            self._density.correlation[...] = self._target.settings.correlation
