"""Machine code with a symbol or an address, called from other machine code."""
