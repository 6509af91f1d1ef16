"""Measurement of the number of particles that a noisy likelihood needs."""
