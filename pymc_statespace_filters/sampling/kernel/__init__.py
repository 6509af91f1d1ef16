"""Iterations of a chain in machine code: proposal, acceptance, adaptation."""
