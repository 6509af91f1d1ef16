"""DRAM, delayed rejection adaptive Metropolis, as a PyMC step method.

The mathematics is in ``delayed_rejection`` and ``adaptation``, an iteration in ``chain``; this page
is the glue to PyMC.
"""

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np
from pymc.model import Model, modelcontext
from pymc.stats.convergence import SamplerWarning
from pymc.step_methods.compound import BlockedStep, StepMethodState
from pymc.step_methods.state import dataclass_state
from pymc.util import RandomGenerator, get_random_generator
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.progress import stat_values, step_columns
from pymc_statespace_filters.sampling.kernel.random_numbers import BLOCK, draw_key
from pymc_statespace_filters.sampling.kernel.state import Random, State
from pymc_statespace_filters.sampling.output import sample_stats as statistics
from pymc_statespace_filters.sampling.output.warnings import Record, closing_warning
from pymc_statespace_filters.sampling.run.chain import RunningChain
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.sampling.target.target import Target


@dataclass_state
class DRAMState(StepMethodState):
    """What PyMC stores of a chain: with it, the chain goes on as if never interrupted."""

    tune: bool
    _state: State | None
    _key: np.ndarray
    _iteration: int
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
    screen : filter, optional
        A cheap filter for the same systems. Moves are made on its likelihood, delayed rejection and
        all; only where one ends the model's own is evaluated, and decides (surrogate transition).
        A filter with noise is used on the noise of the model's seed. The chain is right
        for any screen that is possible wherever the posterior is.
    screen_power : float, default 0.5
        In (0, 1]: tempers the likelihood of the screen, which else vetoes good points where it is
        wrong by many nats.
    correlation : float, optional
        In (0, 1): each proposal has the noise of the current point, moved by an autoregression, in
        place of noise of its own (Deligiannidis et al. 2018). Particle filters then resample in
        the order of the states. Needs ``stages=1`` and no noisy screen: with a second proposal the
        densities of the noise would not cancel.
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
        log-density on the unconstrained space, as estimated when the chain came to the point
    ``d_seed``
        for each noisy variable "d", the noise seed behind that estimate; if the noise is moved
        there is none, and ``correlation`` says by how much
    ``proposal_cov``, ``scaling``
        covariance of the first stage's proposals, shape (d, d), unless other step methods move
        continuous variables; and the geometric mean of its standard deviations
    ``n_evaluations``, ``n_failed``, ``failure``
        evaluations of the model; how many failed, so that the point counts as impossible; and the
        last one's reason, a key of ``inspection.FAILURES`` or -1: NaN or plus infinity
    ``n_effective``
        with a noisy likelihood: the smallest effective number of particles behind ``lp``
    ``n_screened``, ``n_screen_failed``
        with a screen: its evaluations, and how many failed
    ``exact``
        whether the chain targets the posterior itself, without the bias of a filter

    A chain that stood still after warm-up, or whose evaluations often failed, says so when it ends,
    through PyMC's logger.

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

    # Of the chain now running, as in DRAMState.
    _has_started: bool
    _chain: RunningChain | None
    _block: tuple[int, Random] | None
    _key: np.ndarray
    _iteration: int
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
        self.settings = DRAMSettings(
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
        self.vars = list(self._target.held.variables)
        self.blocked = blocked
        self.rng = get_random_generator(rng)
        self.stats_dtypes = [statistics.dtypes(self._target)]
        self.stats_dtypes_shapes = statistics.dtypes_shapes(self._target)
        self._reset(tune=0, draws=0)

    def __getstate__(self) -> dict:
        """Leave the machine code behind: another process takes its own."""
        return self.__dict__ | {"_chain": None, "_block": None, "_has_started": False}

    def setup_chain(self, rng: RandomGenerator, tune: int, draws: int) -> None:
        """Begin a chain afresh, as PyMC asks for once per chain."""
        super().setup_chain(rng, tune, draws)
        self._reset(tune, draws)

    def stop_tuning(self) -> None:
        """Freeze the proposals."""
        super().stop_tuning()
        self._record = Record()

    def step(self, point: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[dict]]:
        """Make one iteration from a point of the model."""
        running, codes = self._stand_at(point)
        index, first = divmod(self._iteration, BLOCK)
        if self._block is None or self._block[0] != index:
            self._block = index, self._target.random(self._key, index)
        running.advance(self.tune, self._block[1], first, 0, 1)
        self._iteration += 1
        running.add_evaluations(codes)
        self._record = self._record.include(running.draws, 0)
        is_last = not self.tune and self._record.iterations == self._n_draws
        stats = statistics.of_draws(self._target, running.draws, 0)
        stats["accept_rate"] = self._record.accept_rate
        stats[statistics.WARNING] = self._closing_warning() if is_last else None
        if stats["accepted"] or self._point is None:
            self._point = point | self._target.held.split(running.state.position.copy())
        return self._point, [stats]

    def _closing_warning(self) -> SamplerWarning | None:
        # PyMC does not tell a step method which chain it makes.
        return closing_warning(self._record, self._target.growth(self._running.proposal_cov))

    def _reset(self, tune: int, draws: int) -> None:
        self.tune = tune > 0
        self._chain = None
        self._has_started = False
        self._key = draw_key(self.rng)
        self._iteration = 0
        self._record = Record()
        self._n_draws = draws
        self._disperse = tune > 0
        self._point = None
        self._block = None

    def _stand_at(self, point: dict[str, np.ndarray]) -> tuple[RunningChain, tuple[int, ...]]:
        """Bring the chain to a point; it and the failure codes of the evaluations that took."""
        running = self._running
        if self._has_started and point is self._point:
            return running, ()
        self._point = None
        target = self._target
        position = target.held.join(point)
        others = [np.array(point[name]) for name in target.density.others]
        if not self._has_started or not np.array_equal(position, running.state.position):
            start = [position]
            if self._disperse:
                start = target.starts.candidates(position, self.rng)
            self._disperse = False
            codes = running.start(start, others, self.rng)
            self._has_started = True
            return running, codes
        if all(map(np.array_equal, others, running.others)):
            return running, ()
        # The noisy parts depend on none of the others: the same noise gives the same estimate.
        return running, (running.evaluate_again(others),)

    @property
    def _running(self) -> RunningChain:
        """The chain's machinery, with the data as they are when it is first asked for."""
        if self._chain is None:
            self._target.prepare()
            self._chain = RunningChain(self._target, 1, 1)
        return self._chain

    @property
    def _state(self) -> State | None:
        """A copy of where the chain stands; None before its first point."""
        if not self._has_started:
            return None
        return State(*(array.copy() for array in self._running.state))

    @_state.setter
    def _state(self, state: State | None) -> None:
        self._has_started = state is not None
        if state is not None:
            self._running.adopt(state)
