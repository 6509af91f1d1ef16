"""From traced equations to machine code."""
