"""How many particles a record needs."""
