"""Iterations of a chain that moves the records of a panel one by one."""
