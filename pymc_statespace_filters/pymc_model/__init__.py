"""A system and its record in a PyMC model."""
