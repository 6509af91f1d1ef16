"""Other packages, each in its own file that runs in the environment where it is installed.

A file defines functions of a seed that return a log-likelihood, and ends with `serve.serve`: the
process reads one request per line and answers with a line of JSON.
"""
