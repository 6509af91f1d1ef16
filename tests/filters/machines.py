"""Hand-made compiled systems for unit tests, and the exact Kalman likelihood of the linear ones.

A machine has the attributes of `filters.protocol.System` that a filter reads.
"""

import numpy as np
from numba import njit

from pymc_statespace_filters.filters import CompiledFunction


class Machine:
    """Sizes, free states and njit functions; hashable by identity."""

    def __init__(self, functions, **values):
        self.__dict__ |= {f.__name__: CompiledFunction(f) for f in functions} | values
        self.carried, self.states = (), tuple(f"x{i}" for i in range(self.n))
        self.n_start, self.gaussian, self.with_gaussian_steps = self.n, self, self
        self.gaussian_observation = self.additive_noise = True
        self.observation_uses_inputs = False
        self.has_exact_observation_density = True


def _additive_observation(H, R):
    """``observe`` and ``log_density`` of d = H x + e, e ~ N(0, R), R diagonal."""
    p, n = H.shape
    sd = np.sqrt(np.diag(R))

    @njit
    def observe(c, inputs, k, t, Z, X, D):
        for b in range(p):
            for i in range(X.shape[1]):
                D[b, i] = sd[b] * Z[b, i]
                for a in range(n):
                    D[b, i] += H[b, a] * X[a, i]

    @njit
    def log_density(c, inputs, k, t, d, X, out):
        for i in range(X.shape[1]):
            out[i] = 0.0
            for b in range(p):
                if not np.isnan(d[b]):
                    residual = d[b]
                    for a in range(n):
                        residual -= H[b, a] * X[a, i]
                    z = residual / sd[b]
                    out[i] -= 0.5 * z * z + np.log(sd[b]) + 0.5 * np.log(2.0 * np.pi)

    return observe, log_density


def linear_machine(F, G, H, R, m0, L0, free=None):
    """x' = theta[0] F x + G z, d = H x + e, x_0 ~ N(m0, L0 L0^T)."""
    F, G, H, R, m0, L0 = (np.array(a, dtype=float) for a in (F, G, H, R, m0, L0))
    n, m = G.shape
    observe, log_density = _additive_observation(H, R)

    @njit
    def prepare(theta):
        return theta[:1].copy()

    @njit
    def initialise(c, Z, X):
        for a in range(n):
            for i in range(X.shape[1]):
                X[a, i] = m0[a]
                for b in range(n):
                    X[a, i] += L0[a, b] * Z[b, i]

    @njit
    def propagate(c, inputs, k, t, Z, X):
        new = np.empty(n)
        for i in range(X.shape[1]):
            for a in range(n):
                new[a] = 0.0
                for b in range(n):
                    new[a] += c[0] * F[a, b] * X[b, i]
                for b in range(m):
                    new[a] += G[a, b] * Z[b, i]
            for a in range(n):
                X[a, i] = new[a]

    return Machine(
        (prepare, initialise, propagate, observe, log_density),
        n=n, m=m, p=H.shape[0], r=H.shape[0], n_inputs=0, n_theta=1, n_constants=1, dt=0.1,
        free=np.arange(n) if free is None else np.array(free, dtype=np.int64),
        matrices=(F, G, H, R, m0, L0),
    )  # fmt: skip


def kalman(machine, steps, observed, scale=1.0):
    """Exact log p(d_j | d_1 .. d_{j-1}) of a linear machine, (J,)."""
    F, G, H, R, m, L0 = machine.matrices
    F, P, k, terms = scale * F, L0 @ L0.T, 0, []
    for step, d in zip(steps, observed, strict=True):
        for _ in range(k, step):
            m, P = F @ m, F @ P @ F.T + G @ G.T
        k = step
        seen = ~np.isnan(d)
        h, residual = H[seen], d[seen] - H[seen] @ m
        S = h @ P @ h.T + R[np.ix_(seen, seen)]
        K = np.linalg.solve(S, h @ P).T
        m, P = m + K @ residual, P - K @ h @ P
        quadratic = residual @ np.linalg.solve(S, residual)
        terms.append(-0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * S)[1]))
    return np.array(terms)


def scalar_machine():
    """One state, one observable."""
    return linear_machine([[0.9]], [[0.5]], [[1.0]], [[0.3]], [1.0], [[0.7]])


def oscillator_machine():
    """Two states, two observables of unlike precision, noise on the velocity only: singular Q."""
    return linear_machine(
        F=[[1.0, 0.1], [-0.2, 0.95]],
        G=[[0.0], [0.3]],
        H=[[1.0, 0.0], [0.5, 1.0]],
        R=[[0.05, 0.0], [0.0, 0.2]],
        m0=[0.5, 0.0],
        L0=[[0.4, 0.0], [0.1, 0.5]],
    )


def simulate(machine, steps, seed):
    """One record of a linear machine, (J, p)."""
    F, G, H, R, m0, L0 = machine.matrices
    rng = np.random.default_rng(seed)
    x, k, record = m0 + L0 @ rng.standard_normal(m0.size), 0, []
    for step in steps:
        for _ in range(k, step):
            x = F @ x + G @ rng.standard_normal(G.shape[1])
        k = step
        record.append(H @ x + np.sqrt(np.diag(R)) * rng.standard_normal(R.shape[0]))
    return np.array(record)


def scalar_record():
    """The scalar machine observed at irregular steps, one observation missing."""
    machine = scalar_machine()
    steps = np.array([0, 1, 3, 4, 8, 9, 12, 15])
    observed = simulate(machine, steps, seed=4)
    observed[3] = np.nan
    return machine, steps, observed


def oscillator_record():
    """The oscillator with components missing one by one and both at once."""
    machine = oscillator_machine()
    steps = np.array([0, 2, 4, 5, 9, 12, 14, 20, 22, 25])
    observed = simulate(machine, steps, seed=7)
    observed[1, 0] = observed[4, 1] = observed[6, 0] = np.nan
    observed[7] = np.nan
    return machine, steps, observed


def double_well_machine():
    """dx = (theta[0] x + theta[1] x^3) dt + 0.6 dW, x_0 ~ N(theta[2], theta[3]^2), d = x + e."""
    dt = 0.01
    observe, log_density = _additive_observation(np.array([[1.0]]), np.array([[0.08]]))

    @njit
    def prepare(theta):
        return theta.copy()

    @njit
    def initialise(c, Z, X):
        x, z = X[0], Z[0]
        for i in range(x.size):
            x[i] = c[2] + c[3] * z[i]

    @njit(error_model="numpy")
    def propagate(c, inputs, k, t, Z, X):
        x, z = X[0], Z[0]
        linear, cubic, sd = 1.0 + dt * c[0], dt * c[1], 0.6 * np.sqrt(dt)
        for i in range(x.size):
            x[i] = linear * x[i] + cubic * x[i] * x[i] * x[i] + sd * z[i]

    return Machine(
        (prepare, initialise, propagate, observe, log_density),
        n=1, m=1, p=1, r=1, n_inputs=0, n_theta=4, n_constants=4, dt=dt, free=np.arange(1),
    )  # fmt: skip


DOUBLE_WELL = np.array([4.0, -4.0, 1.0, 0.7])
"""Parameters of the double well: drift, mean and standard deviation of the start."""


def evaluate(run, machine, steps, observed, seed=0, theta=(1.0,), normals=()):
    """Call a compiled filter with the types that the lowering hands over."""
    return run(
        np.asarray(theta, dtype=float),
        np.asarray(steps, dtype=np.int64),
        np.asarray(observed, dtype=float),
        np.zeros((0, 0)),
        0.0,
        (seed, np.array(normals, dtype=float)),
    )
