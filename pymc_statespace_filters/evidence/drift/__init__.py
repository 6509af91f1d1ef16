"""Is a parameter constant or does it drift: Bayes factors from draws of the drifting model."""
