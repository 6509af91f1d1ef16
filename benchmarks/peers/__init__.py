"""Other packages, each in a file of its own that runs in the environment where it is installed.

A file defines functions of a seed that return a log-likelihood, and ends in `serve.serve`: the
process reads a request a line and answers with a line of JSON.
"""
