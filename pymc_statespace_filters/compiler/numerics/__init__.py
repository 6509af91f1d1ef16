"""Compiled mathematical functions that depend on no model."""
