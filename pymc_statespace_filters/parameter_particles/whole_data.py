"""From the prior to the posterior with all data at once, by raising the likelihood to powers."""

import json
from collections.abc import Callable, Mapping

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ..checks.coverage.missed_modes import LEAST_EVALUATIONS, Visited, joined, missed_mode, thinned
from ..checks.coverage.sentences import sentence_of_mode
from ..filters.protocol import Filter
from ..parallel.signals import interrupts_are_noted
from ..pymc_model.other_filter import model_with
from ..pymc_model.prior import ModelFactors
from ..smc.bridge import Cloud, Crossed, Stage, cross
from ..smc.particles import Evaluate, Particles
from .particle_request import Request, Run, check_alive, columns_of, steps_of
from .stored_run import arrays_of_cloud, cloud_of_arrays
from .stored_steps import StoredSteps

MOST_VISITED = 30_000  # points of all stages that are kept
LOOK = 0.12  # of the evaluations of a run, that may go into a look for what it has missed
_LOOK = 2**32 + 3  # key of random numbers beside those of the run

Array = NDArray[np.float64]


class WholeLikelihood:
    """The likelihood of a model, Potentials included, as one factor after the prior.

    ``factors`` evaluate both; ``screen`` is the same by a cheap filter, if there is one.
    """

    def __init__(self, model: pm.Model, screen: Filter | None = None) -> None:
        self.factors = ModelFactors(model)
        self.screen: Evaluate | None = None
        if screen is not None:
            self.screen = WholeLikelihood(model_with(model, "screen", screen)).evaluate

    def draw(self, count: int, rng: np.random.Generator) -> Particles:
        """Draws of the prior."""
        return self.evaluate(self.factors.prior.sample(count, rng), rng)

    def evaluate(self, x: Array, rng: np.random.Generator) -> Particles:
        """Particles at points, a noisy likelihood estimated with fresh noise at each of them."""
        seeds = self.factors.likelihood.fresh_seeds(len(x), rng)
        log_prior, log_likelihood = self.factors.evaluate_with(x, seeds)
        none = np.empty((len(x), 0))
        return Particles(x, log_prior, np.zeros(len(x)), log_likelihood, seeds, none)


def tempered_run(
    model: pm.Model,
    likelihood: WholeLikelihood,
    request: Request,
    show: Callable[[float, str], None],
    steps: StoredSteps,
    *,
    looks: bool,
) -> tuple[Run, Visited | None]:
    """Lead draws of the prior to the posterior, or particles from where they were stored.

    Also returns points of all stages if the run ``looks`` at them; None if they were not stored.
    """
    rng = request.generator(0)
    begin: Cloud | Crossed
    if steps.found:
        begin = _restored(steps.found, rng)
        visited = _visited_before(steps.found) if looks else None
    else:
        begin = request.cloud(likelihood.draw(request.n_particles, rng))
        check_alive(model, begin)
        visited = thinned(_visited(begin, 0), MOST_VISITED) if looks else None

    def on_stage(so_far: Crossed) -> None:
        nonlocal visited
        stage = so_far.stages[-1]
        if stage.temperature == 1.0:
            interrupts_are_noted()
        if visited is not None:
            new = _visited(so_far.cloud, len(so_far.stages))
            visited = thinned(joined([visited, new]), MOST_VISITED)
        steps.save(
            lambda: _stored(so_far, visited, rng) | request.arrays,
            is_last=stage.temperature == 1.0,
        )
        sizes = f"effective size {stage.effective_sizes.mean():.0f}"
        text = f"temperature {stage.temperature:.3g}, {sizes}, acceptance {stage.acceptance:.2f}"
        show(stage.temperature, text)

    found = cross(
        begin,
        likelihood.evaluate,
        request.size,
        rng,
        refresh=True,
        screen=likelihood.screen,
        on_stage=on_stage,
    )
    return Run(found.cloud, found.log_ratio, _course(found.stages)), visited


def missed_in(
    run: Run,
    visited: Visited | None,
    model: pm.Model,
    likelihood: WholeLikelihood,
    request: Request,
) -> list[str] | None:
    """What the particles of a run lack of the posterior, at the price of a part of the run.

    None without points, or where this part is too small for a look.
    """
    n_evaluations = int(LOOK * (request.n_particles + run.course["n_evaluated"].sum().item()))
    if visited is None or n_evaluations < LEAST_EVALUATIONS:
        return None

    def evaluate(x: Array, rng: np.random.Generator) -> Array:
        found = likelihood.evaluate(x, rng).log_density(1.0)
        return np.where(np.isnan(found), -np.inf, found)

    missed = missed_mode(
        run.cloud.others,
        run.log_evidences,
        visited,
        evaluate,
        n_evaluations,
        request.generator(_LOOK),
    )
    return [] if missed is None else [sentence_of_mode(model, missed, request.draws)]


def _visited(cloud: Cloud, stage: int) -> Visited:
    """The points of a stage that have a density."""
    parts = [one.particles for one in (cloud.pilot, cloud.others)]
    x = np.concatenate([one.x for one in parts])
    log_density = np.concatenate([one.log_density(1.0) for one in parts])
    alive = np.flatnonzero(np.isfinite(log_density))
    return Visited(x[alive], log_density[alive], np.full(len(alive), stage))


def _visited_before(arrays: Mapping[str, np.ndarray]) -> Visited | None:
    """None of a run that did not look, of which the points are lost."""
    if "visited_x" not in arrays:
        return None
    return Visited(*(arrays[f"visited_{name}"] for name in Visited._fields))


def _stored(
    so_far: Crossed, visited: Visited | None, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """How far a run is, and its next random numbers, as arrays."""
    stages = {f"stages_{name}": values for name, values in columns_of(so_far.stages).items()}
    generator = np.array(json.dumps(rng.bit_generator.state))
    found = {"log_ratio": so_far.log_ratio, "generator": generator}
    if visited is not None:
        found |= {f"visited_{name}": values for name, values in visited._asdict().items()}
    return arrays_of_cloud(so_far.cloud) | stages | found


def _restored(arrays: Mapping[str, np.ndarray], rng: np.random.Generator) -> Crossed:
    """The same from arrays; the generator is set."""
    rng.bit_generator.state = json.loads(str(arrays["generator"]))
    stages = steps_of(Stage, arrays, "stages_")
    return Crossed(cloud_of_arrays(arrays), arrays["log_ratio"], stages)


def _course(stages: list[Stage]) -> xr.Dataset:
    """What happened at each temperature."""
    columns = columns_of(stages)
    sizes = columns.pop("effective_sizes").T
    found = xr.Dataset({name: ("stage", values) for name, values in columns.items()})
    return found.assign(effective_size=(("population", "stage"), sizes))
