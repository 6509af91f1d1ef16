"""What targets have in common: the variables that are moved, and what is known of them."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...pymc_model.inspection import (
    check_observed,
    exactness,
    noise_seeds,
    noisy_filters,
)
from ...pymc_model.unused_priors import warn_of_unused_priors
from .initial_points import StartDraws
from .settings import RandomWalkSettings
from .variables import RaveledVariables, check_noise_dependencies, continuous_value_vars


class Growth(NamedTuple):
    """The variable whose proposals are widest relative to the draws from its prior."""

    name: str
    factor: float


class SampledModel:
    """A model, the variables that a sampler moves, their prior draws and noise seeds.

    ``vars`` are continuous variables, by default all; ``samples_all`` tells whether no other step
    method moves further ones. ``exact`` tells whether the chains target the posterior itself,
    without the bias of a filter's noise, and ``seed_names`` has the noise seeds, one for each noisy
    StateSpace variable. Raises `ModelError` if a variable is discrete, there are none, or a noisy
    StateSpace depends on others than ``vars``.
    """

    def __init__(
        self, model: Model, vars: Sequence[TensorVariable] | None, settings: RandomWalkSettings
    ):
        check_observed(model)
        warn_of_unused_priors(model)
        self.model, self.settings = model, settings
        variables = continuous_value_vars(vars, model)
        self._seeds = noise_seeds(model)
        check_noise_dependencies(model, variables, self._seeds)
        self.exact = exactness(model) and (settings.refresh_noise or not self._seeds)
        self.seed_names = tuple(f"{name}_seed" for name in self._seeds)
        self.samples_all = set(variables) >= set(model.continuous_value_vars)
        self._default = model.initial_point(random_seed=0)
        self.raveled = RaveledVariables(variables, self._default)
        if not self.raveled.dim:
            raise ModelError("model must have at least one free variable to sample, got none")
        self.prior_draws = StartDraws(model, self.raveled, self._default)

    @cached_property
    def noisy_filters(self) -> list[Any]:
        """The filters whose likelihood is an estimate."""
        return list(noisy_filters(self.model).values())

    def _read_seeds(self) -> None:
        seeds = [seed.get_value() for seed in self._seeds.values()]
        self.fixed_seeds = np.array(seeds, dtype=np.int64)

    def _growth(self, variances: np.ndarray, of_prior: np.ndarray) -> Growth:
        ratios = variances / of_prior
        most = int(ratios.argmax())
        return Growth(self.raveled.name_at(most), float(ratios[most]) ** 0.5)
