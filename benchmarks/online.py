"""Microseconds for a row that comes alone, by an EKF with two states: ours, and others installed.

filterpy and simdkalman evaluate the same linear system, with its matrices given.

    python -m benchmarks.online
"""

from collections.abc import Callable
from importlib import import_module
from time import process_time

import numpy as np

import pymc_statespace_filters as psf

N_ROWS, N_REPEATS = 3000, 5
K, S, DT = 2.0, 0.5, 0.05
DATA = np.random.default_rng(0).normal(size=N_ROWS)
F = np.array([[1.0, DT], [-K * DT, 1.0 - 0.3 * DT]])
Q, H, R, P = np.diag([0.0, S * S * DT]), np.array([[1.0, 0.0]]), np.array([[0.1]]), 0.1 * np.eye(2)


def ours() -> Callable[[int], object]:
    """`online` with an EKF."""
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x, k: [x[1], -k * x[0] - 0.3 * x[1]], [[0.0], [S]], dt=DT),
        observation=lambda x: [x[0]], observation_noise=R, initial_mean=[1.0, 0.0], initial_cov=P,
    )  # fmt: skip
    update = psf.online(system, psf.EKF(), {"k": K}).update
    return lambda i: update(DATA[i], step=i + 1)


def filterpy() -> Callable[[int], object]:
    """Its Kalman filter, with the log-likelihood of each row."""
    kalman = import_module("filterpy.kalman").KalmanFilter(2, 1)
    kalman.x, kalman.P, kalman.F, kalman.Q = np.array([1.0, 0.0]), P, F, Q
    kalman.H, kalman.R = H, R

    def row(i: int) -> object:
        kalman.predict()
        kalman.update(DATA[i])
        return kalman.log_likelihood

    return row


def simdkalman() -> Callable[[int], object]:
    """Its primitives."""
    steps = import_module("simdkalman.primitives")
    state = [np.array([[[1.0], [0.0]]]), P[None]]

    def row(i: int) -> object:
        predicted = steps.predict(*state, F[None], Q[None])
        state[:] = steps.update(*predicted, H[None], R[None], DATA[i].reshape(1, 1, 1))[:2]
        return state

    return row


def main() -> None:
    """Print the median of some repeats of each, one after the other in turn."""
    seconds: dict[str, list[float]] = {}
    for _ in range(N_REPEATS):
        for make in (ours, filterpy, simdkalman):
            try:
                row = make()
            except ModuleNotFoundError:
                continue
            row(0)
            began = process_time()
            for i in range(1, N_ROWS):
                row(i)
            seconds.setdefault(make.__name__, []).append((process_time() - began) / (N_ROWS - 1))
    for name, found in seconds.items():
        print(f"{name:12} {1e6 * float(np.median(found)):6.1f} us")


if __name__ == "__main__":
    main()
