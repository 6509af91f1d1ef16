"""Recursion, derivative, batch evaluation and smoother of the extended Kalman filter."""
