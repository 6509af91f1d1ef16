"""Compiled mathematical functions that know no model."""
