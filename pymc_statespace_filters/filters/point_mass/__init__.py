"""The density of one state: on a uniform grid, or on segments where none holds it."""
