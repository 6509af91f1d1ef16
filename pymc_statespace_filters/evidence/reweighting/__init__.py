"""The exact posterior from draws of an approximate one."""
