"""DRAM, delayed rejection adaptive Metropolis, as a PyMC step method.

The mathematics is in ``delayed_rejection`` and ``adaptation``; this page is the glue to PyMC.
"""

from collections.abc import Sequence
from dataclasses import field

import numpy as np
from pymc.model import Model, modelcontext
from pymc.step_methods.compound import BlockedStep, StepMethodState
from pymc.step_methods.state import dataclass_state
from pymc.util import RandomGenerator, get_random_generator
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.inspection import COLLAPSED, exactness, noise_seeds
from pymc_statespace_filters.sampling import progress, statistics
from pymc_statespace_filters.sampling.adaptation import AdaptationState, start_adaptation
from pymc_statespace_filters.sampling.health import Record, closing_warning
from pymc_statespace_filters.sampling.held_variables import (
    HeldVariables,
    check_noise_is_held,
    continuous_value_vars,
)
from pymc_statespace_filters.sampling.log_density import LogDensity
from pymc_statespace_filters.sampling.randomness import Batch, draw_seeds, take
from pymc_statespace_filters.sampling.settings import DRAMSettings, checked_proposal_cov, stage_pair
from pymc_statespace_filters.sampling.starts import Starts, best_start
from pymc_statespace_filters.sampling.transition import EvaluatedPoint, Move, delayed_rejection_move


@dataclass_state
class DRAMState(StepMethodState):
    """What PyMC stores of a chain: with it, the chain goes on as if never interrupted."""

    tune: bool
    _current: EvaluatedPoint | None
    _adaptation: AdaptationState
    _batch: Batch | None
    _record: Record
    _n_draws: int
    _disperse: bool
    settings: DRAMSettings = field(metadata={"frozen": True})


class DRAM(BlockedStep):
    """Delayed rejection adaptive Metropolis, for likelihoods with and without noise.

    A Gaussian random walk on the unconstrained space whose covariance is learnt during warm-up
    (thesis, Eqs. 3.27-3.29) and then frozen; where a proposal is rejected, closer ones may follow
    (Eqs. 3.30-3.32). It needs no gradient, evaluates the model exactly once for each proposal, and
    is right where the likelihood is only estimated: the estimate that let a point in stays with it
    and is never drawn again.

    Parameters
    ----------
    vars : list of variables, optional
        Continuous variables to sample. Default: all free variables of the model.
    stages : int or (int, int), default (2, 1)
        Proposals tried in an iteration, or a pair: while tuning, afterwards. 1 is plain
        random-walk Metropolis-Hastings. Further stages help a chain out of a bad start; once the
        covariance is good they rarely pay for their evaluations.
    stage_scale : float, default 0.2
        Stage k proposes ``N(y, stage_scale^(2 (k - 1)) C)`` around the current point y.
    adaptation : {"chain", "continuous"}, default "chain"
        How the covariance C is learnt: in blocks, each proposing with what the blocks before taught
        (the thesis's scheme), or at every iteration (Haario et al. 2001). Both stop with tuning.
    adapt_every : int, default 100
        Iterations in a block.
    proposal_cov : array_like, shape (d, d), optional
        Covariance of the first proposals, on the unconstrained space, in the order of ``vars``.
        Default: the prior's variances, times 2.38^2 / d.
    refresh_noise : bool, default True
        Whether each proposal of each stage gets a noise seed of its own. The chain then targets
        prior times expected likelihood: the exact posterior if the estimate is unbiased. False
        holds the model's seed: common random numbers, a deterministic target that carries that
        seed's error. Without a noisy likelihood it makes no difference.
    model : pymc.Model, optional
        Default: the model of the ``with`` block.
    initial_point, compile_kwargs, rng, blocked
        What PyMC passes to any step method; the first is not used.

    Raises
    ------
    ModelError
        If an argument is not as described, a variable is discrete, or a noisy StateSpace depends
        on variables that are not among ``vars``; when sampling starts, if the log-density is minus
        infinity at the start.

    Notes
    -----
    PyMC starts all chains of a step method at one point. The first iteration of warm-up moves each
    to a draw from the prior at which the log-density is finite (under a flat prior, to the model's
    starting point plus U(-1, 1)), unless ``tune=0`` or starting values were given. Where another
    step method has moved, the current point is evaluated again, with its own seeds.

    ``sample_stats`` holds for each draw

    ``accepted``, ``stage``, ``accept_rate``
        1 where the chain moved, else 0; by which stage (0: none); and the share of iterations that
        moved since warm-up or sampling began
    ``accept``
        probability of accepting the first stage's proposal
    ``lp``
        log-density on the unconstrained space, as estimated when the point was proposed
    ``d_seed``
        for each noisy variable "d", the noise seed behind that estimate
    ``proposal_cov``, ``scaling``
        covariance of the first stage's proposals, shape (d, d); and the geometric mean of its
        standard deviations
    ``n_evaluations``, ``n_failed``, ``failure``
        evaluations of the model; how many failed, so that the point counts as impossible; and the
        last one's reason, a key of ``inspection.FAILURES`` or -1: NaN or plus infinity

    A chain that stood still after warm-up, or whose evaluations often failed, says so when it ends,
    through PyMC's logger.

    References
    ----------
    H. Haario, M. Laine, A. Mira and E. Saksman (2006). DRAM: efficient adaptive MCMC. Statistics
    and Computing 16, 339-354.
    C. Andrieu and G. O. Roberts (2009). The pseudo-marginal approach for efficient Monte Carlo
    computations. Annals of Statistics 37, 697-725.

    Examples
    --------
    >>> import pymc as pm
    >>> from pymc_statespace_filters.sampling import DRAM
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 10)
    ...     sigma = pm.HalfNormal("sigma", 2)
    ...     y = pm.Normal("y", mu, sigma, observed=[1.2, 0.7, 2.9, 1.8])
    ...     idata = pm.sample(500, tune=500, chains=2, cores=1, step=DRAM(), random_seed=1,
    ...                       progressbar=False)
    >>> idata["sample_stats"]["proposal_cov"].shape
    (2, 500, 2, 2)
    """

    name = "dram"
    default_blocked = True
    _state_class = DRAMState
    _progressbar_config = staticmethod(progress.columns)
    _make_progressbar_update_functions = staticmethod(progress.update_functions)

    # Of the chain now running, as in DRAMState.
    _current: EvaluatedPoint | None
    _adaptation: AdaptationState
    _batch: Batch | None
    _record: Record
    _n_draws: int
    _disperse: bool
    # The dictionary last returned: if it comes back, nothing has changed since.
    _point: dict[str, np.ndarray] | None

    def __init__(
        self,
        vars: Sequence[TensorVariable] | None = None,
        *,
        stages: int | tuple[int, int] = (2, 1),
        stage_scale: float = 0.2,
        adaptation: str = "chain",
        adapt_every: int = 100,
        proposal_cov: np.ndarray | None = None,
        refresh_noise: bool = True,
        model: Model | None = None,
        initial_point: dict[str, np.ndarray] | None = None,
        compile_kwargs: dict | None = None,
        rng: RandomGenerator = None,
        blocked: bool = True,
    ):
        model = modelcontext(model)
        self.settings = DRAMSettings(
            stage_pair(stages), stage_scale, adaptation, adapt_every, refresh_noise
        )
        self.vars = continuous_value_vars(vars, model)
        self.blocked = blocked
        self.rng = get_random_generator(rng)

        seeds = noise_seeds(model)
        check_noise_is_held(model, self.vars, seeds)
        self._exact = exactness(model) and (refresh_noise or not seeds)
        self._seed_names = tuple(f"{name}_seed" for name in seeds)
        self._seed_variables = tuple(seeds.values())
        default = model.initial_point(random_seed=0)
        self._log_density = LogDensity(
            model, self.vars, default, seeds, compile_kwargs, holds_noise=not refresh_noise
        )
        self._held = HeldVariables(self.vars, default)
        self._starts = Starts(model, self._held, default)
        dim = self._held.dim
        if proposal_cov is None:
            self._first_cov = self._starts.covariance()
        else:
            self._first_cov = checked_proposal_cov(proposal_cov, dim)
        self.stats_dtypes = [statistics.dtypes(dim, self._seed_names)]
        self.stats_dtypes_shapes = statistics.dtypes_shapes(dim, self._seed_names)
        self._reset(tune=0, draws=0)

    def setup_chain(self, rng: RandomGenerator, tune: int, draws: int) -> None:
        """Begin a chain afresh, as PyMC asks for once per chain."""
        super().setup_chain(rng, tune, draws)
        self._log_density.prepare()
        self._reset(tune, draws)

    def stop_tuning(self) -> None:
        """Freeze the proposals."""
        super().stop_tuning()
        self._record = Record()

    def step(self, point: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[dict]]:
        """Make one iteration from a point of the model."""
        current, codes = self._stand_at(point)
        move = self._move(current)
        codes += move.failures
        self._current = move.point
        collapsed = move.point.n_effective < COLLAPSED
        self._record = self._record.include(move.stage > 0, codes, collapsed)
        is_last = not self.tune and self._record.iterations == self._n_draws
        stats = statistics.of_draw(
            move,
            codes,
            seed_names=self._seed_names,
            exact=self._exact,
            accept_rate=self._record.accept_rate,
            adaptation=self._adaptation,
            warning=closing_warning(self._record) if is_last else None,
        )
        if self.tune:
            self._adaptation = self.settings.adapt(
                self.settings.adaptation_settings, self._adaptation, move.point.position, move.stage
            )
        if move.stage > 0 or self._point is None:
            self._point = point | self._held.split(move.point.position)
        return self._point, [stats]

    def _reset(self, tune: int, draws: int) -> None:
        self.tune = tune > 0
        self._current = None
        self._point = None
        self._adaptation = start_adaptation(self._first_cov)
        self._batch = None
        self._record = Record()
        self._n_draws = draws
        self._held_seeds = tuple(np.array(s.get_value()) for s in self._seed_variables)
        self._disperse = tune > 0

    def _stand_at(self, point: dict[str, np.ndarray]) -> tuple[EvaluatedPoint, tuple[int, ...]]:
        """Give the current point with its estimate, and the failure codes of what that took."""
        current = self._current
        if current is not None and point is self._point:
            return current, ()
        self._point = None
        position = self._held.join(point)
        others = tuple(np.array(point[name]) for name in self._log_density.others)
        if current is None or not np.array_equal(position, current.position):
            return self._start(position, others)
        if all(map(np.array_equal, others, current.others)):
            return current, ()
        # The noisy parts depend on none of the others: the same seeds give the same estimate.
        again = self._evaluate(position, others, current.seeds)
        return again, (again.failure,)

    def _start(
        self, position: np.ndarray, others: tuple[np.ndarray, ...]
    ) -> tuple[EvaluatedPoint, tuple[int, ...]]:
        """Evaluate a first point, dispersed unless somebody chose it."""
        candidates = self._starts.candidates(position, self.rng) if self._disperse else [position]
        self._disperse = False

        def evaluate_afresh(candidate: np.ndarray) -> EvaluatedPoint:
            seeds = draw_seeds(self.rng, (len(self._seed_names),))
            return self._evaluate(candidate, others, self._noise(seeds))

        return best_start(candidates, evaluate_afresh)

    def _noise(self, fresh: np.ndarray) -> tuple[np.ndarray, ...]:
        """Turn drawn seeds into arguments, or put the held ones in their place."""
        if self.settings.refresh_noise:
            return tuple(np.asarray(seed) for seed in fresh)
        return self._held_seeds

    def _evaluate(
        self,
        position: np.ndarray,
        others: tuple[np.ndarray, ...],
        seeds: tuple[np.ndarray, ...],
    ) -> EvaluatedPoint:
        return EvaluatedPoint(position, others, seeds, *self._log_density(position, others, seeds))

    def _move(self, current: EvaluatedPoint) -> Move:
        settings = self.settings
        self._batch, share = take(
            self._batch, self.rng, max(settings.stages), self._held.dim, len(self._seed_names)
        )
        n_stages = settings.stages[0 if self.tune else 1]
        return delayed_rejection_move(
            lambda position, seeds: self._evaluate(position, current.others, seeds),
            current,
            self._adaptation.chol,
            settings.stage_scale,
            share.normals,
            share.log_uniforms,
            [self._noise(seeds) for seeds in share.seeds[:n_stages]],
        )
