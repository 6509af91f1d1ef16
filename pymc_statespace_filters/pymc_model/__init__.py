"""State-space systems as variables of a PyMC model."""

# Registers how the variable is drawn, also where a model is only unpickled.
from . import dispatch as dispatch
