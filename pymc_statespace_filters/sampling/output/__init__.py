"""From draws to a DataTree, statistics and warnings."""
