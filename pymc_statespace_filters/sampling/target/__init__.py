"""The log-density that a chain evaluates."""
