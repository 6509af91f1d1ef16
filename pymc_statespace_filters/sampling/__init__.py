"""Samplers of a model's log-density and noise seeds, independent of its filters."""

from .chosen_sampler import sample
from .dram_chains import sample_dram
from .particle_number import suggest_particles
from .starts.find_starts import find_starts
from .step import DRAM

__all__ = [
    "DRAM",
    "find_starts",
    "sample",
    "sample_dram",
    "suggest_particles",
]
