"""What all chains of a run share: the log-densities, and where chains start."""

from collections.abc import Sequence

import numpy as np
from pymc.model import Model
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.pymc_model.inspection import exactness, noise_seeds, state_space_names
from pymc_statespace_filters.sampling.kernel.random_numbers import random_block
from pymc_statespace_filters.sampling.kernel.state import Random
from pymc_statespace_filters.sampling.output.warnings import Growth
from pymc_statespace_filters.sampling.target.initial_points import Starts
from pymc_statespace_filters.sampling.target.leader_follower import check_group
from pymc_statespace_filters.sampling.target.log_density import LogDensity, screening_density
from pymc_statespace_filters.sampling.target.settings import DRAMSettings, checked_proposal_cov
from pymc_statespace_filters.sampling.target.variables import (
    HeldVariables,
    check_noise_is_held,
    continuous_value_vars,
)


class Target:
    """A model as the sampler sees it.

    Parameters
    ----------
    model : pymc.Model
    vars : sequence of TensorVariable, optional
        Continuous variables to sample. Default: all.
    settings : DRAMSettings
    proposal_cov : array_like, shape (d, d), optional
    compile_kwargs : dict, optional
        Passed to PyMC's compiler.
    graph : TensorVariable, optional
        The log-density if it is not the model's own.
    group : Ranks, optional
        Ranks that evaluate the noisy likelihoods together, of which this is the first.

    Attributes
    ----------
    held : HeldVariables
    starts : Starts
    density : LogDensity
    screen : LogDensity or None
    first_cov : ndarray, shape (d, d)
        Covariance of the first proposals.
    exact : bool
        Whether the chains target the posterior itself, without the bias of a filter's noise.
    seed_names : tuple of str
        Of the noise seeds that are noted down.
    holds_all : bool
        Whether no other step method moves continuous variables.

    Raises
    ------
    ModelError
        If a variable is discrete, there are none, a noisy StateSpace depends on others than
        ``vars``, or ``proposal_cov``, the screen or the group does not fit.
    """

    def __init__(
        self,
        model: Model,
        vars: Sequence[TensorVariable] | None,
        settings: DRAMSettings,
        proposal_cov: np.ndarray | None = None,
        compile_kwargs: dict | None = None,
        *,
        graph: TensorVariable | None = None,
        group: Communicator | None = None,
    ):
        group = None if group is None or group.size == 1 else group
        if group is not None:
            check_group(model, settings, group.size)
        self.settings = settings
        variables = continuous_value_vars(vars, model)
        seeds = noise_seeds(model)
        check_noise_is_held(model, variables, seeds)
        self.exact = exactness(model) and (settings.refresh_noise or not seeds)
        self.seed_names = tuple(f"{name}_seed" for name in seeds)
        self._seed_variables = tuple(seeds.values())
        self.holds_all = set(variables) >= set(model.continuous_value_vars)
        default = model.initial_point(random_seed=0)
        self.held = HeldVariables(variables, default)
        if not self.held.dim:
            raise ModelError("vars: the model has no free variable to sample")
        self.starts = Starts(model, self.held, default)
        if proposal_cov is None:
            self.first_cov = self.starts.covariance()
        else:
            self.first_cov = checked_proposal_cov(proposal_cov, self.held.dim)

        shared = (model, variables, default, seeds, compile_kwargs)
        self.density = LogDensity(
            *shared,
            holds_noise=not settings.refresh_noise,
            correlation=settings.correlation,
            graph=graph,
            group=group,
        )
        self.screen = None
        if settings.screen is not None:
            if not state_space_names(model):
                raise ModelError(
                    f"screen={settings.screen!r}: the model has no StateSpace variable"
                )
            graph = screening_density(model, settings.screen, settings.screen_power)
            self.screen = LogDensity(*shared, holds_noise=settings.screen.noisy, graph=graph)

    @property
    def moves_noise(self) -> bool:
        """Whether a chain carries its noise along."""
        return self.settings.correlation is not None and bool(self.seed_names)

    def prepare(self) -> None:
        """Take hold of machine code, and of data and held seeds as they are now."""
        self.held_seeds = np.array([s.get_value() for s in self._seed_variables], dtype=np.int64)
        self.density.prepare()
        if self.screen is not None:
            self.screen.prepare()

    def growth(self, cov: np.ndarray) -> Growth:
        """Compare a covariance of proposals with that of the prior's draws."""
        variances = np.diag(cov) / np.diag(self.starts.covariance())
        most = int(variances.argmax())
        return Growth(self.held.name_at(most), float(variances[most]) ** 0.5)

    def random(self, key: np.ndarray, index: int) -> Random:
        """Draw a block of random numbers for a chain with this key."""
        shape = max(self.settings.stages), self.held.dim, len(self.seed_names)
        block = random_block(key, index, *shape)
        if not self.settings.refresh_noise:
            block.seeds[...] = self.held_seeds
        return block
