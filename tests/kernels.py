"""Flat settings of chains, as parametrized tests list them, as arguments of the samplers."""

from dataclasses import fields

from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings

_OF_KERNEL = {field.name for field in fields(RandomWalkSettings)}


def with_kernel(settings):
    """Settings with those of the random walk in ``kernel``, and those of ranks in ``comm``."""
    of_kernel = {name: settings[name] for name in settings if name in _OF_KERNEL}
    rest = {name: value for name, value in settings.items() if name not in _OF_KERNEL}
    ranks = {name: rest.pop(name) for name in ("per_chain", "gather") if name in rest}
    if ranks:
        rest["comm"] = {"comm": rest.get("comm"), **ranks}
    return rest | ({"kernel": of_kernel} if of_kernel else {})
