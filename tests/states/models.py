"""Linear models with draws made by hand, and the exact laws of their states at each draw."""

import arviz as az
import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from tests.references.linear_states import linear_states
from tests.systems import FORCED_DATA, PAIR, PAIR_DATA, STEPS, counts, forced

EKF = psf.EKF()
ALL_STEPS = np.arange(7)
# Times that are no step numbers, with step 0 at T0; inputs and time enter everywhere.
DT, T0 = 0.5, 10.0
FORCE = np.array([0.5, -0.2, 0.1, 0.3, 0.0, -0.4, 0.7])
PUSHED = forced(
    dt=DT,
    transition=lambda x, q, u, t, a: [a * x[0] + u[0] + 0.1 * t + q[0]],
    observation=lambda x, u, t: [x[0] + 2.0 * u[0] - 0.3 * t],
)
SHAPE = (2, 3)  # chains, draws: no square, and every number another
A = np.random.default_rng(1).uniform(-0.5, 0.9, SHAPE)
B = np.random.default_rng(2).uniform(-0.5, 0.9, SHAPE)
DATA_NOISE = np.array([[0.5, 0.1], [0.1, 0.4]])


def posterior(**values):
    """A DataTree of these draws, each (chain, draw, ...)."""
    return az.from_dict({"posterior": values})


def pair_model(filter=EKF, params=None, observed=PAIR_DATA, steps=STEPS, **settings):
    """PAIR with the free variable `a`, unless parameters are given."""
    with pm.Model() as model:
        if params is None:
            pm.Normal("a")
        psf.StateSpace("d", PAIR, filter, params=params, steps=steps, observed=observed, **settings)
    return model


def pushed_model(inputs=FORCE):
    """PUSHED with the free variable `a`."""
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", PUSHED, EKF, steps=STEPS, observed=FORCED_DATA, inputs=inputs, t0=T0)
    return model


def counted_model(initial_mean):
    """Counts of one state, with the free variable `level`, two of them observed."""
    system = counts(initial_mean=initial_mean)
    with pm.Model() as model:
        pm.Normal("level")
        psf.StateSpace("d", system, psf.BootstrapPF(100), steps=[0, 1], observed=[1.0, 2.0])
    return model


def pair_law(moment, rows, a, b=0.2, observed=PAIR_DATA, steps=STEPS):
    """The exact law of PAIR's states."""
    return linear_states(
        [[a, b], [0.0, 0.8]], np.diag([1.0, 0.5]), np.eye(2), DATA_NOISE, [0.0, 0.3],
        np.diag([1.0, 2.0]), steps=steps, observed=observed, rows=rows, moment=moment,
    )  # fmt: skip


def pushed_law(moment, rows, a, force=FORCE):
    """The exact law of PUSHED's state."""
    push = np.asarray(force) + 0.1 * (T0 + DT * np.arange(len(force)))
    return linear_states(
        [[a]], [[1.0]], [[1.0]], [[0.5]], [0.0], [[1.0]], steps=STEPS,
        observed=FORCED_DATA - shown(STEPS, force), rows=rows, moment=moment,
        forcing=push[:, None],
    )  # fmt: skip


def shown(steps, force):
    """What an observation of PUSHED shows beside the state."""
    return 2.0 * np.asarray(force)[steps] - 0.3 * (T0 + DT * steps)


def assert_exact(group, laws, name="d"):
    """Mean and sd of each draw are those of its own law; ``laws`` (chain, draw) holds them."""
    found = group[f"{name}_mean"].values, group[f"{name}_sd"].values
    for place, law in np.ndenumerate(laws):
        np.testing.assert_allclose(found[0][place], law.mean, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(found[1][place], law.sd, rtol=1e-9, atol=1e-10)


def laws_of(law, *parameters):
    """The law at each draw of the parameters, as an array of objects (chain, draw)."""
    arrays = np.broadcast_arrays(*parameters)
    laws = np.empty(arrays[0].shape, dtype=object)
    for place in np.ndindex(laws.shape):
        laws[place] = law(*(array[place] for array in arrays))
    return laws
