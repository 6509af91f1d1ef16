"""One iteration of a chain, in machine code."""
