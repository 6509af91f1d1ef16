"""Truths to measure the package against, written without any of its code.

Each file is one independent answer, as a point-mass filter (``grid``) or all states of a linear
system at once (``linear_states``); ``records`` has the records that they are compared on.
"""
