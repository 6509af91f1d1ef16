"""What helps chains of a model that mix slowly, by name."""

from pymc.model import Model

from ...pymc_model.inspection import gradient_obstacle, kinked_variable, noisy_filters


def ways_to_mix(model: Model, name: str) -> str:
    """What works for this model if the chains are slow along the element with this name."""
    ways = ["tune longer"]
    if not gradient_obstacle(model) and kinked_variable(model) is None:
        ways.append("use psf.sample(sampler='nuts')")
    if noisy_filters(model):
        ways.append("give the filter more particles (psf.suggest_particles)")
    return ", ".join([*ways, f"or reparametrise {name}"])
