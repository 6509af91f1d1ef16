"""From a system to its compiled functions."""
