"""Chains on disk."""
