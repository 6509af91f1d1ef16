"""Hybrid systems: regimes beside continuous states, which are Gaussian given them."""
