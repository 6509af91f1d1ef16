"""Checks of results: of the filters, and of what the draws cover of the posterior."""
