"""Chains in threads and over ranks, from the request to the results."""
