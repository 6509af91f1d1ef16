"""State-space systems as variables of a PyMC model."""
