"""What a user writes: equations, forces, integrators, records, parameters; checked here."""
