"""Samplers of a model's log-density and noise seeds, independent of its filters."""

from .particle_number.suggest import suggest_particles
from .sample import run_models, sample_dram
from .starts.find_starts import find_starts
from .step import DRAM

__all__ = ["DRAM", "find_starts", "run_models", "sample_dram", "suggest_particles"]
