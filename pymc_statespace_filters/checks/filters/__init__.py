"""Whether a filter's likelihood is that of its system: comparisons with unbiased filters."""
