"""From a PyTensor graph to scalar expressions, source and compiled functions."""
