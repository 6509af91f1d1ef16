"""Experiments before they are made: what a record of each design is expected to say."""

from .expected_information import expected_information
from .identifiability import identifiability

__all__ = ["expected_information", "identifiability"]
