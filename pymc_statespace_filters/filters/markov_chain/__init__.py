"""The recursion of `FiniteStateFilter`, forward and back, compiled once for all systems."""
