"""The log-likelihood of a record as PyTensor operations: its value, and its derivative."""
