"""A model as the sampler sees it: its log-densities, and where chains start.

`Target` has a `LogDensity` for the model and one for the screen, if there is one. `LogDensity` is
the compiled graph; its ``bind`` gives a `BoundLogDensity`, callable from one thread, whose
``native`` is what machine code calls.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from pymc.model import Model
from pytensor.gradient import NullTypeGradError
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.rows import Rows
from ...errors import GradientUnavailableError, ModelError
from ...filters.protocol import Filter
from ...parallel.communicator import Communicator
from ...parallel.signals import held_interrupts
from ...pymc_model.graph_rewrites import coarse_filters, expensive_variables, pilot_filters
from ...pymc_model.inspection import state_space_nodes
from ...pymc_model.panel_structure import panel_structure
from ..kernel.state import ChainState, RandomBlock, draw_seeds, random_block
from ..kernel.transition import evaluate
from .leader_follower import check_group
from .log_density import LogDensity, screening_density, tempered_density
from .sampled_model import Growth, SampledModel
from .settings import RandomWalkSettings, checked_proposal_cov

PILOT_POWER = 0.5
MANY_DIMENSIONS = 9  # in which moves along the gradient are worth its compilation
_MOST_CURVED = 512  # dimensions; the curvature takes two gradients for each


class Target(SampledModel):
    """A model as the sampler sees it, whose variables are moved together.

    ``proposal_cov`` (d, d) is of the first proposals; ``compile_kwargs``, ``graph`` and ``group``
    are as of `LogDensity`. Raises `ModelError` as `SampledModel`, and if ``proposal_cov``, the
    screen or the group does not fit.
    """

    def __init__(
        self,
        model: Model,
        vars: Sequence[TensorVariable] | None,
        settings: RandomWalkSettings,
        proposal_cov: np.ndarray | None = None,
        compile_kwargs: dict | None = None,
        *,
        graph: TensorVariable | None = None,
        group: Communicator | None = None,
    ):
        group = None if group is None or group.size == 1 else group
        if group is not None:
            check_group(model, settings, group.size)
        super().__init__(model, vars, settings)
        self._group = group
        if proposal_cov is None:
            self.first_cov = self.prior_draws.covariance()
        else:
            self.first_cov = checked_proposal_cov(proposal_cov, self.raveled.dim)
        variables, seeds = self.raveled.variables, self._seeds
        self._shared = (model, variables, self._default, seeds, compile_kwargs)
        self.density = LogDensity(
            *self._shared,
            fixed_noise=not settings.refresh_noise,
            correlation=settings.correlation,
            graph=graph,
            group=group,
        )
        self.screen = None
        if settings.screen is not None:
            if not state_space_nodes(model):
                raise ModelError(
                    f"screen needs a model with a StateSpace variable, got {settings.screen!r} for "
                    "a model without one"
                )
            graph = screening_density(model, settings.screen, settings.screen_power)
            self.screen = LogDensity(*self._shared, fixed_noise=settings.screen.noisy, graph=graph)

    @cached_property
    def takes_curvature(self) -> bool:
        """Whether curvature makes coordinates where points are too few for them.

        Not of a panel, whose parameters are many and correlated within records only.
        """
        return self.raveled.dim <= _MOST_CURVED and panel_structure(self.model) is None

    @cached_property
    def is_expensive(self) -> bool:
        """Whether an evaluation takes milliseconds, not microseconds."""
        return bool(expensive_variables(self.model))

    def coarse_density(self) -> LogDensity | None:
        """The log-density with coarse filters, if there are any; noise as in ``density``."""
        filters = coarse_filters(self.model)
        return self.density_with(filters) if filters else None

    def density_with(self, filters: Mapping[str, Filter]) -> LogDensity:
        """The log-density with other filters, given by the names of their variables."""
        graph = tempered_density(self.model, filters, 1.0)
        fixed_noise = not self.settings.refresh_noise
        return LogDensity(*self._shared, fixed_noise=fixed_noise, graph=graph)

    def pilot_density(self) -> LogDensity | None:
        """Prior times the square root of a Gaussian likelihood, if the filters are expensive."""
        filters = self._pilot_filters()
        if not filters:
            return None
        graph = tempered_density(self.model, filters, PILOT_POWER)
        return LogDensity(*self._shared, fixed_noise=True, graph=graph)

    def _pilot_filters(self) -> dict[str, Filter]:
        """The filters of the pilot.

        In few dimensions particles find the posterior of counts as well without an `IPLF`, whose
        compilation takes seconds.
        """
        return pilot_filters(self.model, takes_counts=self.raveled.dim >= MANY_DIMENSIONS)

    def gradient_rows(self, *, of_pilot: bool) -> Rows | None:
        """The log-density, or that of the pilot, with its gradient as the last result.

        None if a likelihood is noisy, or has no gradient.
        """
        graph = None
        if of_pilot:
            graph = tempered_density(self.model, self._pilot_filters(), PILOT_POWER)
        elif self.is_expensive:
            return None
        try:
            return LogDensity(
                *self._shared, fixed_noise=of_pilot, graph=graph, with_gradient=True
            ).at_rows()
        except (GradientUnavailableError, NotImplementedError, NullTypeGradError):
            return None

    @property
    def carries_noise(self) -> bool:
        """Whether proposals have noise correlated with that of the current point."""
        return self.settings.correlation is not None and bool(self.seed_names)

    def evaluation(self) -> Callable[[], object]:
        """A function that evaluates the log-density once, to measure what it costs."""
        bound = self.density.bind()

        def evaluation() -> None:
            with held_interrupts():
                evaluate(bound.native)

        return evaluation

    @property
    def evaluates_alone(self) -> bool:
        """Whether points and fresh seeds are all that an evaluation needs."""
        return self._group is None and not self.carries_noise

    def evaluate_afresh(self, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Log-densities (m,) at points (m, d), each with fresh noise; -inf where they fail."""
        seeds = draw_seeds(rng, (len(x), len(self.seed_names)))
        found = self.density.at_rows()(x, *seeds.T)[0]
        return np.where(found < np.inf, found, -np.inf)

    def prepare(self) -> None:
        """Load the machine code, and read data and fixed seeds as they are now."""
        self._read_seeds()
        self.density.prepare()
        if self.screen is not None:
            self.screen.prepare()

    def growth(self, state: ChainState) -> Growth:
        """Compare a chain's proposal covariance with that of the draws from the prior."""
        return self._growth(np.diag(state.proposal_cov), np.diag(self.prior_draws.covariance()))

    def random_block(self, key: np.ndarray, index: int) -> RandomBlock:
        """Draw a block of random numbers for a chain with this key."""
        shape = max(self.settings.stages), self.raveled.dim, len(self.seed_names)
        block = random_block(key, index, *shape)
        if not self.settings.refresh_noise:
            block.seeds[...] = self.fixed_seeds
        return block
