"""NUTS by nutpie, with starts and results as of the other samplers."""
