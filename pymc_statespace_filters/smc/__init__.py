"""Sequential Monte Carlo over points of any space: particles, kernels, bridges; no models."""
