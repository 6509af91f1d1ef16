"""DRAM, delayed rejection adaptive Metropolis, as a PyMC step method.

The formulas are in `kernel.delayed_rejection` and `kernel.adaptation`, an iteration in
`kernel.transition`; this module connects them to PyMC.
"""

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np
from pymc.model import Model, modelcontext
from pymc.stats.convergence import SamplerWarning, WarningType
from pymc.step_methods.compound import BlockedStep, StepMethodState
from pymc.step_methods.state import dataclass_state
from pymc.util import RandomGenerator, get_random_generator
from pytensor.tensor.variable import TensorVariable

from ..facts import sentences
from .kernel.state import ChainState, draw_key
from .output import sample_stats
from .output.chain_bars import stat_values, step_columns
from .output.facts import EndedChain
from .output.phase_statistics import PhaseStatistics
from .run.chain import Chain
from .target.settings import RandomWalkSettings
from .target.target import Target


@dataclass_state
class DRAMState(StepMethodState):
    """The state of a chain that PyMC stores: the chain continues from it with the same draws."""

    tune: bool
    _state: ChainState | None
    _key: np.ndarray
    _iteration: int
    _statistics: PhaseStatistics
    _n_draws: int
    _disperse: bool
    settings: RandomWalkSettings = field(metadata={"frozen": True})


class DRAM(BlockedStep):
    """Delayed rejection adaptive Metropolis, for likelihoods with and without noise.

    A Gaussian random walk on the unconstrained space whose covariance is adapted during warm-up
    (thesis, Eqs. 3.27-3.29) and then frozen; after a rejected proposal, closer ones may follow
    (Eqs. 3.30-3.32). It needs no gradient, evaluates the model exactly once for each proposal, and
    is exact for an estimated likelihood: the estimate with which a point was accepted is kept, and
    is not computed again.

    Parameters
    ----------
    vars : list of variables, optional
        Continuous variables to sample. Default: all free variables of the model.
    stages : int or (int, int), default (2, 1)
        Maximum number of proposals in an iteration, or a pair: during tuning and afterwards. 1 is
        random-walk Metropolis-Hastings. Further stages help a chain to leave a bad start; once the
        covariance is good they rarely pay for their evaluations.
    stage_scale : float, default 0.2
        Stage k proposes ``N(y, stage_scale^(2 (k - 1)) C)`` around the current point y.
    adaptation : {"chain", "continuous"}, default "chain"
        When the covariance C is updated: after blocks of iterations (the thesis's scheme), or at
        every iteration (Haario et al. 2001). Both stop with tuning.
    adapt_every : int, default 100
        Iterations in a block.
    proposal_cov : array_like, shape (d, d), optional
        Covariance of the first proposals, on the unconstrained space, in the order of ``vars``.
        Default: the prior's variances, times 2.38^2 / d.
    refresh_noise : bool, default True
        Whether each proposal of each stage gets its own noise seed. The chain then targets prior
        times expected likelihood: the exact posterior if the estimate is unbiased. False fixes the
        model's seed (common random numbers): the target is deterministic, with the error of that
        seed. Without a noisy likelihood it makes no difference.
    screen : filter, optional
        A cheap filter for the same systems. Moves, with delayed rejection, are made on its
        likelihood; the model's own is evaluated only at their end points and decides on them
        (surrogate transition). A filter with noise uses the model's seed. The chain is exact for
        any screen whose density is positive wherever the posterior's is.
    screen_power : float, default 0.5
        Exponent, in (0, 1], that tempers the likelihood of the screen. Untempered it rejects good
        points where it is wrong by many nats.
    correlation : float, optional
        In (0, 1): the noise of each proposal is an autoregression on the noise of the current point
        (Deligiannidis et al. 2018). Particle filters then resample in the order of the states. It
        needs ``stages=1`` and a screen without noise: with a second proposal the densities of the
        noise would not cancel.
    model : pymc.Model, optional
        Default: the model of the ``with`` block.
    initial_point, compile_kwargs, rng, blocked
        Passed by PyMC to any step method; the first is not used.

    Raises
    ------
    ModelError
        If an argument is not as described, a variable is discrete, or a noisy StateSpace depends
        on variables that are not among ``vars``; when sampling starts, if the log-density is minus
        infinity at the start.

    Notes
    -----
    PyMC starts all chains of a step method at one point. The first iteration of warm-up moves each
    to a draw from the prior with finite log-density (under a flat prior, to the model's initial
    point plus U(-1, 1)), unless ``tune=0`` or initial values were given. After a move of another
    step method the current point is evaluated again, with its own seeds.

    ``sample_stats`` contains for each draw

    ``accepted``, ``stage``, ``accept_rate``
        1 if a proposal was accepted, else 0; of which stage (0: none); and the fraction of
        iterations with an accepted proposal since the beginning of warm-up or sampling
    ``accept``
        acceptance probability of the first stage's proposal
    ``lp``
        log-density on the unconstrained space, as estimated when the point was accepted
    ``d_seed``
        for each noisy variable "d", the noise seed of that estimate; for correlated noise there is
        ``correlation`` instead
    ``proposal_cov``, ``scaling``
        covariance of the first stage's proposals, shape (d, d), unless other step methods move
        continuous variables; and the geometric mean of its standard deviations
    ``n_evaluations``, ``n_failed``, ``failure``
        evaluations of the model; how many failed, so that the proposal was rejected; and the last
        failure code, a code of ``filters.outcomes.Failure``
    ``n_effective``
        with a noisy likelihood: the smallest effective number of particles of the estimate ``lp``
    ``n_screened``, ``n_screen_failed``
        with a screen: its evaluations, and how many failed
    ``exact``
        whether the chain targets the posterior itself, without the bias of a filter

    PyMC's logger warns at the end of a chain that hardly moved after warm-up, or whose evaluations
    often failed. PyMC calls a step method for one chain at a time, so that no chain can be compared
    with another one: PyMC's own warning of R-hat is all that a chain in a lower mode gives rise to.
    `sample_dram` compares the chains, and names one that stays far below the others;
    ``idata.sample_stats.lp.median("draw")`` does so for draws of ``pm.sample``.

    References
    ----------
    G. Deligiannidis, A. Doucet and M. K. Pitt (2018). The correlated pseudo-marginal method.
    Journal of the Royal Statistical Society B 80, 839-870.
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
    _progressbar_config = staticmethod(step_columns)
    _make_progressbar_update_functions = staticmethod(lambda: (stat_values,))

    # Of the current chain, as in DRAMState.
    _has_started: bool
    _chain: Chain | None
    _key: np.ndarray
    _iteration: int
    _statistics: PhaseStatistics
    _n_draws: int
    _disperse: bool
    # The dictionary last returned: if PyMC passes it again, nothing has changed since.
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
        screen: Any = None,
        screen_power: float = 0.5,
        correlation: float | None = None,
        model: Model | None = None,
        initial_point: dict[str, np.ndarray] | None = None,
        compile_kwargs: dict | None = None,
        rng: RandomGenerator = None,
        blocked: bool = True,
    ):
        model = modelcontext(model)
        self.settings = RandomWalkSettings(
            stages,
            stage_scale,
            adaptation,
            adapt_every,
            refresh_noise,
            correlation,
            screen,
            screen_power,
        )
        self._target = Target(model, vars, self.settings, proposal_cov, compile_kwargs)
        self.vars = list(self._target.raveled.variables)
        self.blocked = blocked
        self.rng = get_random_generator(rng)
        self.stats_dtypes = [sample_stats.dtypes(self._target)]
        self.stats_dtypes_shapes = sample_stats.dtypes_shapes(self._target)
        self._reset(tune=0, draws=0)

    def __getstate__(self) -> dict:
        """Leave out the machine code, which another process loads itself."""
        return self.__dict__ | {"_chain": None, "_has_started": False}

    def setup_chain(self, rng: RandomGenerator, tune: int, draws: int) -> None:
        """Begin a new chain, once per chain of PyMC."""
        super().setup_chain(rng, tune, draws)
        self._reset(tune, draws)

    def stop_tuning(self) -> None:
        """Freeze the proposals."""
        super().stop_tuning()
        self._statistics = PhaseStatistics()

    def step(self, point: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[dict]]:
        """Make one iteration from a point of the model."""
        chain, failures = self._move_to(point)
        chain.advance(self.tune, self._iteration, 0, 1)
        self._iteration += 1
        chain.add_evaluations(failures)
        self._statistics = self._statistics.include(chain.draws, 0)
        is_last = not self.tune and self._statistics.iterations == self._n_draws
        stats = sample_stats.of_draws(self._target, chain.draws, 0)
        stats["accept_rate"] = self._statistics.accept_rate
        stats[sample_stats.WARNING] = self._closing_warning() if is_last else None
        if stats["accepted"] or self._point is None:
            self._point = point | self._target.raveled.unravel(chain.state.position.copy())
        return self._point, [stats]

    def _closing_warning(self) -> SamplerWarning | None:
        # Without the number of the chain, which PyMC does not pass to a step method.
        growth = self._target.growth(self._prepared_chain.state)
        found = sentences(EndedChain(self._target, self._statistics, growth))
        return SamplerWarning(WarningType.BAD_ACCEPTANCE, found[0], "warn") if found else None

    def _reset(self, tune: int, draws: int) -> None:
        self.tune = tune > 0
        self._chain = None
        self._has_started = False
        self._key = draw_key(self.rng)
        self._iteration = 0
        self._statistics = PhaseStatistics()
        self._n_draws = draws
        self._disperse = tune > 0
        self._point = None

    def _move_to(self, point: dict[str, np.ndarray]) -> tuple[Chain, tuple[int, ...]]:
        """Bring the chain to a point; also the failure codes of the evaluations made."""
        chain = self._prepared_chain
        if self._has_started and point is self._point:
            return chain, ()
        self._point = None
        target = self._target
        position = target.raveled.ravel(point)
        others = [np.array(point[name]) for name in target.density.others]
        if not self._has_started or not np.array_equal(position, chain.state.position):
            candidates = [position]
            if self._disperse:
                candidates = target.prior_draws.candidates(position, self.rng)
            self._disperse = False
            failures = chain.start(candidates, others, self.rng)
            self._has_started = True
            return chain, failures
        if all(map(np.array_equal, others, chain.others)):
            return chain, ()
        # The noisy terms depend on none of the others: the same noise gives the same estimate.
        return chain, (chain.evaluate_again(others),)

    @property
    def _prepared_chain(self) -> Chain:
        """The chain, made on first use from the data as they are then."""
        if self._chain is None:
            self._target.prepare()
            self._chain = Chain(self._target, self._key, 1, 1)
        return self._chain

    @property
    def _state(self) -> ChainState | None:
        """A copy of the state; None before the first point."""
        if not self._has_started:
            return None
        return ChainState(*(array.copy() for array in self._prepared_chain.state))

    @_state.setter
    def _state(self, state: ChainState | None) -> None:
        self._has_started = state is not None
        if state is None:
            self._chain = None  # a chain made before has another key
        else:
            self._prepared_chain.load_state(state)
