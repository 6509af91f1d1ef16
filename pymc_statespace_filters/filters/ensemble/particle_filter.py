"""Which smoother a particle filter has for a system: backward simulation, or ancestries."""

from typing import Any

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.lowering.scalar_state import has_additive_process_noise
from pymc_statespace_filters.compiler.lowering.structure import process_noise_reaches_every_state
from pymc_statespace_filters.filters.ensemble.ancestral_smoother import LAG, past_kernel
from pymc_statespace_filters.filters.ensemble.backward_simulation import backward_kernel
from pymc_statespace_filters.filters.ensemble.base import EnsembleFilter, system_table
from pymc_statespace_filters.system.model import StateSpaceModel


def _has_transition_density(system: StateSpaceModel) -> bool:
    """Whether a step has a Gaussian density given the state before."""
    return has_additive_process_noise(system) and process_noise_reaches_every_state(system)


def particle_smoother(
    filter: EnsembleFilter, system: StateSpaceModel, machine: Machine, *, nudges: bool
) -> Any:
    """Bind the smoother of a particle filter to one system."""
    with_callback, n_particles = filter.with_callback(machine), filter.size()
    if _has_transition_density(system):
        return backward_kernel(with_callback, system_table(machine), machine, n_particles)
    return past_kernel(with_callback, machine, n_particles, nudges=nudges, lag=LAG)


def particle_smoothing_method(system: StateSpaceModel) -> str:
    """Name the method, and the lag if it has one."""
    if _has_transition_density(system):
        return "backward simulation"
    return f"ancestries, settled {LAG} observations later"
