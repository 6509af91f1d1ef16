"""What every filter that moves members by noise has in common towards the rest of the package."""

from typing import Any, ClassVar

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.lowering import Compiled, Machine, ensemble_machine, key_of
from pymc_statespace_filters.model import StateSpaceModel


class EnsembleFilter:
    """A filter whose likelihood is an estimate made with noise."""

    noisy: ClassVar[bool] = True
    unbiased: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False
    needs_simulated_observations: ClassVar[bool] = False

    def kernel(self, machine: Machine) -> Any:
        """Compile the filter for the functions of one system."""
        raise NotImplementedError

    def check(self, system: StateSpaceModel) -> None:
        """Raise if the system is not one that this filter can treat."""
        if self.needs_simulated_observations and not system.gaussian_observation:
            raise ModelError(
                f"{type(self).__name__} nudges members by a Kalman gain and so needs an "
                f"observation function with Gaussian noise; with observation_dist or "
                f"observation_logp use the particle filters BootstrapPF or PFEnKF"
            )

    def is_exact_for(self, system: StateSpaceModel) -> bool:
        """Whether the expected likelihood is that of the system, for any number of members."""
        # Noise that is not additive enters the density through its linearisation.
        return self.unbiased and (system.additive_noise or not system.gaussian_observation)

    def compile(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health)."""
        machine = ensemble_machine(system)
        return Compiled(self.kernel(machine), key_of(repr(self), machine.key))
