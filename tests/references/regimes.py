"""Switching linear systems by enumeration: a Kalman filter for every path of the regimes."""

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np


@dataclass(frozen=True)
class SwitchingSystem:
    """x' = A[r'] x + b[r'] + u + w, w ~ N(0, Q[r']), of the regime r' that a step leads to.

    Regimes start with the probabilities ``start`` and change by ``P[r, r']``. All regimes have the
    observation H x + e, e ~ N(0, R). They start from N(mean, cov), or each from its own.
    """

    P: np.ndarray
    A: np.ndarray
    b: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    start: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    def paths(self, steps, observed, inputs=None):
        """For every path: its log-probability with the record, last regime, mean and covariance."""
        K, n = len(self.start), self.A.shape[-1]
        mean, cov = np.broadcast_to(self.mean, (K, n)), np.broadcast_to(self.cov, (K, n, n))
        before = [(np.log(p), (r,), mean[r], cov[r]) for r, p in enumerate(self.start) if p]
        k = 0
        for step, d in zip(steps, np.reshape(observed, (len(steps), -1)), strict=True):
            while k < step:
                u = 0.0 if inputs is None else inputs[k]
                before = [path for one in before for path in self._moved(*one, u)]
                k += 1
            before = [self._conditioned(*one, d) for one in before]
        return before

    def log_likelihood(self, steps, observed, inputs=None):
        """The exact log-likelihood of a record."""
        return np.logaddexp.reduce([path[0] for path in self.paths(steps, observed, inputs)])

    def last_moments(self, steps, observed, inputs=None):
        """Probabilities of the last regime, mean and covariance of the last state."""
        paths = self.paths(steps, observed, inputs)
        log_p = np.array([path[0] for path in paths])
        w = np.exp(log_p - np.logaddexp.reduce(log_p))
        regimes = np.array([path[1][-1] for path in paths])
        means = np.array([path[2] for path in paths])
        mean = w @ means
        away = means - mean
        cov = sum(p * path[3] for p, path in zip(w, paths, strict=True))
        return (
            np.array([w[regimes == r].sum() for r in range(len(self.start))]),
            mean,
            cov + (w[:, None] * away).T @ away,
        )

    def smoothed_moments(self, steps, observed, inputs):
        """At every step the probabilities of the regimes, and the mean and covariance of the state.

        Given all observations: by a Kalman smoother for every path.
        """
        data = dict(zip(steps, np.reshape(observed, (len(steps), -1)), strict=True))
        n_steps, n, R = steps[-1] + 1, self.mean.size, len(self.start)
        paths = list(product(range(R), repeat=n_steps))
        found = [self._smoothed(path, data, inputs) for path in paths]
        log_p = np.array([one[0] for one in found])
        w = np.exp(log_p - np.logaddexp.reduce(log_p))
        means, covs = np.array([one[1] for one in found]), np.array([one[2] for one in found])
        mean = np.einsum("p,pki->ki", w, means)
        away = means - mean
        cov = np.einsum("p,pkij->kij", w, covs) + np.einsum("p,pki,pkj->kij", w, away, away)
        regimes = np.array(paths)[:, :, None] == np.arange(R)
        return np.einsum("p,pkr->kr", w, regimes), mean, cov.reshape(n_steps, n, n)

    def _smoothed(self, path, data, inputs):
        """Log-probability of a path and the record, and smoothed means and covariances."""
        log_p, mean, cov = np.log(self.start[path[0]]), self.mean, self.cov
        log_p, _, mean, cov = self._seen(log_p, mean, cov, data.get(0))
        filtered, predicted = [(mean, cov)], []
        for k, (before, r) in enumerate(pairwise(path)):
            mean = self.A[r] @ mean + self.b[r] + inputs[k]
            cov = self.A[r] @ cov @ self.A[r].T + self.Q[r]
            predicted.append((mean, cov))
            log_p, _, mean, cov = self._seen(
                log_p + np.log(self.P[before, r]), mean, cov, data.get(k + 1)
            )
            filtered.append((mean, cov))
        smoothed = [filtered[-1]]
        for k in range(len(path) - 2, -1, -1):
            (mean, cov), (ahead, cov_ahead), (later, cov_later) = (
                filtered[k], predicted[k], smoothed[0]
            )  # fmt: skip
            inverse = np.linalg.pinv(cov_ahead, rcond=1e-9, hermitian=True)
            gain = cov @ self.A[path[k + 1]].T @ inverse
            smoothed.insert(
                0,
                (mean + gain @ (later - ahead), cov + gain @ (cov_later - cov_ahead) @ gain.T),
            )
        return log_p, np.array([s[0] for s in smoothed]), np.array([s[1] for s in smoothed])

    def _seen(self, log_p, mean, cov, d):
        d = np.full(self.H.shape[0], np.nan) if d is None else d
        return self._conditioned(log_p, None, mean, cov, d)

    def _moved(self, log_p, path, mean, cov, u):
        for r, p in enumerate(self.P[path[-1]]):
            if p:
                A = self.A[r]
                moved = A @ mean + self.b[r] + u
                yield log_p + np.log(p), (*path, r), moved, A @ cov @ A.T + self.Q[r]

    def _conditioned(self, log_p, path, mean, cov, d):
        seen = ~np.isnan(d)
        if not seen.any():
            return log_p, path, mean, cov
        H, R = self.H[seen], self.R[np.ix_(seen, seen)]
        S = H @ cov @ H.T + R
        gain = np.linalg.solve(S, H @ cov).T
        away = d[seen] - H @ mean
        log_p -= 0.5 * (away @ np.linalg.solve(S, away) + np.linalg.slogdet(2 * np.pi * S)[1])
        return log_p, path, mean + gain @ away, cov - gain @ S @ gain.T
