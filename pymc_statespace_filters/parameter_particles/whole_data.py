"""From the prior to the posterior with all data at once, by raising the likelihood to powers."""

from collections.abc import Callable

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..pymc_model.prior import ModelFactors
from ..smc.bridge import Stage, cross
from ..smc.particles import Particles
from .request import Request, Run, check_alive

Array = NDArray[np.float64]


class WholeLikelihood:
    """The likelihood of a model, Potentials included, as one factor after the prior.

    ``factors`` evaluate both.
    """

    def __init__(self, model: pm.Model) -> None:
        self.factors = ModelFactors(model)

    def draw(self, count: int, rng: np.random.Generator) -> Particles:
        """Draws of the prior."""
        return self.evaluate(self.factors.prior.sample(count, rng), rng)

    def evaluate(self, x: Array, rng: np.random.Generator) -> Particles:
        """Particles at points, a noisy likelihood estimated with fresh noise at each of them."""
        density = self.factors.density
        seeds = rng.integers(np.iinfo(np.int64).max, size=(len(x), len(density.seed_names)))
        log_prior, log_likelihood = self.factors.evaluate_with(x, seeds)
        none = np.empty((len(x), 0))
        return Particles(x, log_prior, np.zeros(len(x)), log_likelihood, seeds, none)


def tempered_run(
    model: pm.Model,
    likelihood: WholeLikelihood,
    request: Request,
    show: Callable[[float, str], None],
) -> Run:
    """Lead draws of the prior to the posterior."""
    rng = request.generator(0)
    cloud = request.cloud(likelihood.draw(request.n_particles, rng))
    check_alive(model, cloud)

    def on_stage(stage: Stage) -> None:
        sizes = f"effective size {stage.effective_sizes.mean():.0f}"
        text = f"temperature {stage.temperature:.3g}, {sizes}, acceptance {stage.acceptance:.2f}"
        show(stage.temperature, text)

    found = cross(cloud, likelihood.evaluate, request.size, rng, refresh=True, on_stage=on_stage)
    return Run(found.cloud, found.log_ratio, _course(found.stages))


def _course(stages: list[Stage]) -> xr.Dataset:
    """What happened at each temperature."""
    columns = {
        "temperature": [one.temperature for one in stages],
        "n_steps": [one.n_steps for one in stages],
        "acceptance": [one.acceptance for one in stages],
        "scale": [one.scale for one in stages],
    }
    found = xr.Dataset({name: ("stage", values) for name, values in columns.items()})
    sizes = np.stack([one.effective_sizes for one in stages], axis=1)
    return found.assign(effective_size=(("population", "stage"), sizes))
