"""The exact posterior from draws of an approximate one."""

from .reweight import reweight

__all__ = ["reweight"]
