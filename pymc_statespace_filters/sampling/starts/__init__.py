"""Starts of chains: a population that is led from the prior to the posterior."""
