"""The arguments of a run, checked, and what all runs have in common."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple, Self

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError
from ..filters.outcomes import why_zero
from ..pymc_model.density import check_free_variables
from ..pymc_model.elements import places_in_vector
from ..pymc_model.filter_estimates import failures_at
from ..pymc_model.fingerprint import FINGERPRINT_DIGITS, model_data_fingerprint, model_fingerprint
from ..pymc_model.posterior_draws import BY_PARTICLES
from ..smc.bridge import Cloud
from ..smc.moves import Size
from ..smc.particles import Particles, Populations
from ..system.checks import check_count, check_flag

N_EXPLAINED = 100  # prior draws that are evaluated once more to say why their likelihood is zero


class Request(NamedTuple):
    """How many particles and populations, how they are moved, and the key of all random numbers."""

    draws: int
    size: Size
    n_populations: int
    entropy: tuple[int, ...]
    inner: str = ""  # the filter in place of the model's
    screen: str = ""  # the filter by which moves are screened

    @property
    def n_particles(self) -> int:
        """Particles of all populations, the pilot included."""
        return self.size.n_particles * (1 + self.n_populations)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What a step that is stored has to bring along: the key."""
        return {"entropy": np.array(self.entropy)}

    def going_on(self, arrays: Mapping[str, np.ndarray]) -> Self:
        """With the key of a step that was stored, if there is one."""
        return self._replace(entropy=tuple(arrays["entropy"].tolist())) if arrays else self

    def settings(self, model: pm.Model, data: str, *, is_seeded: bool) -> dict[str, Any]:
        """All that a run depends on, as values of JSON.

        Raises `ModelError` if a part of the model has no text that is the same in every process.
        """
        return {
            "sampler": BY_PARTICLES,
            "data": data,
            "draws": self.draws,
            "populations": self.n_populations,
            "waste_free": self.size.waste_free,
            "inner": self.inner,
            "screen": self.screen,
            "random_seed": list(self.entropy) if is_seeded else None,
            "model": model_fingerprint(model)[:FINGERPRINT_DIGITS],
            "observed and other data": model_data_fingerprint(model)[:FINGERPRINT_DIGITS],
            "version": version("pymc-statespace-filters"),
        }

    def generator(self, *key: int) -> np.random.Generator:
        """The random numbers of a part of the run."""
        return np.random.default_rng([*self.entropy, *key])

    def cloud(self, particles: Particles) -> Cloud:
        """Divide particles into the pilot and the other populations."""
        of_pilot = np.arange(len(particles.x)) < self.size.n_particles
        pilot, others = particles.at(of_pilot), particles.at(~of_pilot)
        return Cloud(
            Populations.of_equal_weights(pilot, 1),
            Populations.of_equal_weights(others, self.n_populations),
        )


class Run(NamedTuple):
    """What a run has led to: the particles, the evidence by each population, and its course.

    ``missed`` says of the posterior what the particles lack; None if nothing has looked.
    """

    cloud: Cloud
    log_evidences: NDArray[np.float64]  # (R,)
    course: xr.Dataset
    missed: Sequence[str] | None = None


def checked_request(
    model: pm.Model, draws: int, populations: int, waste_free: bool, entropy: tuple[int, ...]
) -> Request:
    """Check the arguments against the model."""
    check_free_variables(model)
    k = sum(at.size for at in places_in_vector(model).values())
    check_count("draws", draws, 1)
    if draws < 2 * k:
        raise ModelError(
            f"draws must be at least twice the number of parameters, {2 * k}, got {draws}"
        )
    check_count("populations", populations, 2)
    size = Size.of(int(draws), check_flag("waste_free", waste_free))
    return Request(int(draws), size, int(populations), entropy)


def least_alive(cloud: Cloud) -> int:
    """The fewest particles of a population with a positive likelihood that can be moved."""
    return 2 * cloud.pilot.particles.x.shape[1] + 2


def check_alive(model: pm.Model, cloud: Cloud) -> None:
    """Raise if too few particles of the pilot have a positive likelihood."""
    particles, least = cloud.pilot.particles, least_alive(cloud)
    alive = np.isfinite(particles.log_density(1.0))
    if alive.sum() < least:
        dead = particles.x[~alive][:N_EXPLAINED]
        raise ModelError(
            f"the likelihood is positive at {alive.sum()} of {alive.size} draws of the prior, fewer"
            f" than {least}: {why_zero(failures_at(model, dead), len(dead))}, or raise draws"
        )


def columns_of(steps: Sequence[Any]) -> dict[str, np.ndarray]:
    """The fields of named tuples of one type, of which there is at least one, by their names."""
    return dict(zip(steps[0]._fields, map(np.array, zip(*steps, strict=True)), strict=True))


def steps_of[T](kind: type[T], columns: Mapping[str, np.ndarray], prefix: str = "") -> list[T]:
    """The named tuples of a type from columns whose names have a prefix."""
    fields: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]  # of a named tuple
    return [kind(*one) for one in zip(*(columns[prefix + name] for name in fields), strict=True)]
