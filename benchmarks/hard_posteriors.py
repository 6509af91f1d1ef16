"""Posteriors of many parameters, of scales far from the prior's, or with necks."""

from collections.abc import Callable

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from benchmarks.posteriors import mass_spring_damper


def with_priors(
    system, truth: dict[str, float], steps, *, filter=None, inputs=None, seed=1, **priors
) -> pm.Model:
    """A posterior of simulated data; ``priors`` make those of some parameters.

    By default they are LogNormal(log(truth), 1).
    """
    made = psf.simulate(system, truth, steps=steps, inputs=inputs, random_seed=seed)
    with pm.Model() as model:
        for name, value in truth.items():
            if name in priors:
                priors[name](name)
            else:
                pm.LogNormal(name, np.log(np.abs(value)), 1.0, shape=np.shape(value) or None)
        psf.StateSpace(
            "d", system, filter or psf.EKF(), steps=steps, inputs=inputs,
            observed=made["observations"].values,
        )  # fmt: skip
    return model


def _predator_prey_drift(x, r, K, a, h, gain, m):
    prey, predator = pt.exp(x[0]), pt.exp(x[1])
    eaten = a / (1.0 + a * h * prey)
    return [r * (1.0 - prey / K) - eaten * predator, gain * eaten * prey - m]


def _predator_prey(seen: dict[str, float], filter=None, **sensor) -> pm.Model:
    """In logarithms, with saturation; 97 rows of both."""
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            _predator_prey_drift, lambda s1, s2: [[s1, 0.0], [0.0, s2]], dt=0.1
        ),
        initial_mean=lambda x0, y0: [pt.log(x0), pt.log(y0)],
        initial_cov=1e-4 * np.eye(2),
        **sensor,
    )
    truth = {
        "r": 1.0, "K": 5.0, "a": 1.5, "h": 0.5, "gain": 0.6, "m": 0.6, "s1": 0.1, "s2": 0.1,
        "x0": 2.0, "y0": 1.0,
    } | seen  # fmt: skip
    return with_priors(system, truth, np.arange(0, 97 * 5, 5), filter=filter)


def predator_prey() -> pm.Model:
    """Predator and prey, both measured: 11 parameters."""
    return _predator_prey(
        {"sensor": 0.1},
        observation=lambda x: [x[0], x[1]],
        observation_noise=lambda sensor: sensor**2 * np.eye(2),
    )


def predator_prey_counts() -> pm.Model:
    """Predator and prey, both counted: 11 parameters, by `BootstrapPF`."""
    return _predator_prey(
        {"seen": 20.0},
        psf.BootstrapPF(200),
        observation_dist=lambda x, seen: [pm.Poisson.dist(seen * pt.exp(x[i])) for i in range(2)],
    )


def library() -> pm.Model:
    """An equation of FitzHugh and Nagumo, as 20 coefficients of monomials and two scales."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]

    def drift(x, c):
        monomials = pt.stack([x[0] ** i * x[1] ** j for i, j in powers])
        return [(c[k] * monomials).sum() for k in range(2)]

    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda sigma: sigma * np.eye(2), dt=0.1),
        observation=lambda x: [x[0], x[1]],
        observation_noise=lambda sensor: sensor**2 * np.eye(2),
        initial_mean=[-1.0, 1.0],
        initial_cov=1e-2 * np.eye(2),
        shapes={"c": (2, len(powers))},
    )
    c = np.zeros((2, len(powers)))
    c[0, [powers.index(p) for p in ((0, 0), (1, 0), (3, 0), (0, 1))]] = 0.5, 1.0, -1 / 3, -1.0
    c[1, [powers.index(p) for p in ((0, 0), (1, 0), (0, 1))]] = 0.056, 0.08, -0.064
    truth = {"c": c, "sigma": 0.02, "sensor": 0.05}
    return with_priors(
        system, truth, np.arange(500), c=lambda n: pm.Normal(n, shape=(2, len(powers))),
        sigma=lambda n: pm.HalfNormal(n, 0.1), sensor=lambda n: pm.HalfNormal(n, 0.1),
    )  # fmt: skip


def vector_autoregression() -> pm.Model:
    """Three states, nine coefficients, six scales."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: pt.dot(a, x) + q,
        process_noise=lambda sigma: pt.diag(sigma**2),
        observation=lambda x: [x[0], x[1], x[2]],
        observation_noise=lambda sensor: pt.diag(sensor**2),
        initial_mean=np.zeros(3),
        initial_cov=np.eye(3),
        shapes={"a": (3, 3), "sigma": (3,), "sensor": (3,)},
    )
    truth = {
        "a": np.array([[0.7, 0.2, 0.0], [-0.2, 0.6, 0.1], [0.0, 0.1, 0.8]]),
        "sigma": np.full(3, 0.5),
        "sensor": np.full(3, 0.3),
    }
    return with_priors(
        system, truth, np.arange(200), a=lambda n: pm.Normal(n, 0, 0.5, shape=(3, 3)),
        sigma=lambda n: pm.HalfNormal(n, 1, shape=3), sensor=lambda n: pm.HalfNormal(n, 1, shape=3),
    )  # fmt: skip


def glucose() -> pm.Model:
    """The minimal model of glucose after an injection: an equation without noise, 24 rows."""

    def drift(x, u, p1, p2, p3):
        return [-(p1 + x[1]) * x[0] + p1 * 90.0, -p2 * x[1] + p3 * u[0]]

    system = psf.StateSpaceModel(
        transition=psf.RungeKutta4(drift, dt=1.0),
        observation=lambda x: [x[0]],
        observation_noise=lambda sensor: [[sensor**2]],
        initial_mean=lambda g0: [g0, 0.0],
        initial_cov=np.zeros((2, 2)),
        inputs=["insulin"],
    )
    t = np.arange(181.0)
    truth = {"p1": 0.03, "p2": 0.02, "p3": 1e-5, "g0": 290.0, "sensor": 5.0}
    return with_priors(
        system, truth, np.arange(4, 181, 7), inputs=(100 * np.exp(-t / 15.0))[:, None]
    )


def growth() -> pm.Model:
    """Exponential growth, whose rate is known to 6e-9; the prior's standard deviation is one."""
    system = psf.StateSpaceModel(
        transition=psf.RungeKutta4(lambda x, rate: [rate * x[0]], dt=0.1),
        observation=lambda x: [x[0]],
        observation_noise=lambda sensor: [[sensor**2]],
        initial_mean=lambda x0: [x0],
        initial_cov=[[0.0]],
    )
    truth = {"rate": 1.0, "x0": 1.0, "sensor": 1.0}
    return with_priors(system, truth, np.arange(0, 171, 2), rate=lambda n: pm.Normal(n, 0, 1))


def regression() -> pm.Model:
    """A random walk with 48 correlated inputs: 50 parameters, Gaussian given two scales."""
    n = 48
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0]],
        process_noise=lambda sigma: [[sigma**2]],
        observation=lambda x, u, b: [x[0] + pt.dot(b, u)],
        observation_noise=lambda sensor: [[sensor**2]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        inputs=[f"u{i}" for i in range(n)],
        shapes={"b": (n,)},
    )
    rng = np.random.default_rng(5)
    inputs = rng.standard_normal((300, n)) + 2.0 * rng.standard_normal((300, 1))
    truth = {"b": rng.standard_normal(n), "sigma": 0.1, "sensor": 0.5}
    return with_priors(
        system, truth, np.arange(300), inputs=inputs, b=lambda n_: pm.Normal(n_, shape=n)
    )


def volatility() -> pm.Model:
    """Stochastic volatility: one state, 750 rows, by `GridFilter`."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, phi, sigma: [phi * x[0] + sigma * q[0]],
        process_noise=[[1.0]],
        observation_dist=lambda x, scale: [pm.Normal.dist(0.0, scale * pt.exp(x[0] / 2))],
        initial_mean=[0.0],
        initial_cov=lambda phi, sigma: [[sigma**2 / (1 - phi**2)]],
    )
    truth = {"phi": 0.95, "sigma": 0.2, "scale": 1.0}
    return with_priors(
        system, truth, np.arange(750), filter=psf.GridFilter(),
        phi=lambda n: pm.Beta(n, 20, 1.5), sigma=lambda n: pm.HalfNormal(n, 1),
    )  # fmt: skip


SCHOOLS = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])
ERRORS_OF_SCHOOLS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])


def eight_schools() -> pm.Model:
    """Eight schools, centred: a funnel without a system."""
    with pm.Model() as model:
        mu, tau = pm.Normal("mu", 0, 5), pm.HalfCauchy("tau", 5)
        theta = pm.Normal("theta", mu, tau, shape=8)
        pm.Normal("y", theta, ERRORS_OF_SCHOOLS, observed=SCHOOLS)
    return model


HARD: dict[str, Callable[[], pm.Model]] = {
    "predator and prey, 11": predator_prey,
    "counts of predator and prey, 11": predator_prey_counts,
    "mass-spring-damper by particles, 9": lambda: mass_spring_damper(psf.BootstrapPF(200)),
    "library, 22": library,
    "VAR(1), 15": vector_autoregression,
    "glucose, 5": glucose,
    "growth, scale 6e-9": growth,
    "linear-Gaussian, 50": regression,
    "volatility, GridFilter": volatility,
    "eight schools, centred": eight_schools,
}
