"""Densities of the sub-models of a full model, all by one compiled function."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from ..pymc_model.switched_density import DensityInParts, SwitchedDensity, SwitchedPriors
from .candidates import Candidates

BLOCK = 50_000  # points that are evaluated in one call

Array = NDArray[np.float64]
Columns = NDArray[np.int64]
Seeds = NDArray[np.int64]
Sets = NDArray[np.bool_]


class Point(NamedTuple):
    """Points of sub-models: of n of them, the vectors, the terms that are there, noise seeds."""

    x: Array  # (n, k), unconstrained; columns of absent terms have no influence
    present: Sets  # (n, K)
    seeds: Seeds  # (n, v)


class SubmodelDensity:
    """The log-densities of all sub-models.

    ``candidate_of`` (k,) is the candidate of every column of the unconstrained vector; K for none.
    """

    def __init__(self, model: pm.Model, candidates: Candidates) -> None:
        self.model, self.candidates = model, candidates
        self.density = SwitchedDensity(model, candidates.switches)
        self.candidate_of = candidates.switches.number_of(len(self.density.blocks))

    @cached_property
    def variables(self) -> list[TensorVariable]:
        """The free variable of every column."""
        return [self.model[name] for name in self.candidates.elements.variables]

    @cached_property
    def scaled_columns(self) -> Columns:
        """Those of candidates whose priors depend on free variables that are no candidates."""
        model = self.model
        names = [rv.name for rv in self.variables]
        own = {names[column] for one in self.candidates.switches.columns for column in one}
        depends = []
        for rv in model.free_RVs:
            above = {one.name for one in set(ancestors([rv])) & set(model.free_RVs)} - {rv.name}
            if rv.name in own and above and not above & own:
                depends.append(rv.name)
        is_scaled = np.isin(names, depends) & (self.candidate_of < len(self.candidates))
        return np.flatnonzero(is_scaled)

    def log_prior_held(self, x: Array) -> Array:
        """The prior log-densities (n, k) of columns where they are held, given other variables.

        They are zero where `scaled_columns` has no column.
        """
        found = np.zeros_like(x)
        if (scaled := self.scaled_columns).size:
            absent = np.zeros((len(x), len(self.candidates)), dtype=bool)
            held = self.priors.in_parts(x, absent).held
            found[:, scaled] = held[:, self.blocks[scaled]]
        return found

    @cached_property
    def priors(self) -> SwitchedPriors:
        """The priors alone."""
        return self.density.priors()

    @property
    def blocks(self) -> Columns:
        """As of `SwitchedDensity`."""
        return self.density.blocks

    def columns_of(self, present: Sets) -> Columns:
        """The columns that a sub-model has: all but those of absent terms."""
        return np.flatnonzero(np.append(present, True)[self.candidate_of])

    def evaluate(self, at: Point) -> DensityInParts:
        """The densities at points, with the priors in them."""
        rows = [slice(i, i + BLOCK) for i in range(0, max(len(at.x), 1), BLOCK)]
        parts = [
            self.density.evaluate_in_parts(at.x[one], at.present[one], at.seeds[one])
            for one in rows
        ]
        return DensityInParts(*map(np.concatenate, zip(*parts, strict=True)))
