"""The log-density that a chain evaluates, and where chains start."""
