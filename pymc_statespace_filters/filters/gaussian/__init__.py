"""The recursion, derivative, batch and smoother of the extended Kalman filter."""
