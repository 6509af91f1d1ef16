"""From draws to a DataTree: statistics, deterministics, warnings, progress."""
