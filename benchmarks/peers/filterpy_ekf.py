"""filterpy: its extended Kalman filter, one call per step."""

import numpy as np

from benchmarks.peers.serve import record, serve

from filterpy.kalman import ExtendedKalmanFilter  # isort: skip

DT = 0.01
(ALPHA, BETA, SIGMA, GAMMA), STEPS, _, OBSERVED = record("double_well")


class DoubleWell(ExtendedKalmanFilter):
    def predict_x(self, u=0):
        x = self.x
        self.F = 1.0 + DT * (ALPHA + 3.0 * BETA * x[:, None] ** 2)
        self.x = x + DT * (ALPHA * x + BETA * x**3)


def value(seed):
    filter = DoubleWell(dim_x=1, dim_z=1)
    filter.x, filter.P = np.array([1.0]), np.array([[0.5]])
    filter.Q, filter.R = np.array([[DT * (0.36 + SIGMA**2)]]), np.array([[GAMMA]])
    jacobian, total, k = np.eye(1), 0.0, 0
    for j, d in zip(STEPS, OBSERVED, strict=True):
        while k < j:
            filter.predict()
            k += 1
        filter.update(d, lambda x: jacobian, lambda x: x)
        total += filter.log_likelihood
    return total


serve({"double_well/value": lambda: value}, "filterpy", "numpy")
