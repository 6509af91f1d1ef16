"""Samplers of a model's log-density and noise seeds, independent of its filters."""

from pymc_statespace_filters.sampling.particle_number.suggest import suggest_particles
from pymc_statespace_filters.sampling.sample import run_models, sample_dram
from pymc_statespace_filters.sampling.starts.find_starts import find_starts
from pymc_statespace_filters.sampling.step import DRAM

__all__ = ["DRAM", "find_starts", "run_models", "sample_dram", "suggest_particles"]
