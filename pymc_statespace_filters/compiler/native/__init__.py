"""Machine code with a name or an address, called from other machine code."""
