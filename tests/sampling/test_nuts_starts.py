"""NUTS from points of the user, after Ctrl-C, on doubted data, and where it diverges."""

import logging

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.nuts import chains
from pymc_statespace_filters.sampling.nuts.frame import Frame

STEPS = np.arange(1, 41)
WALK = psf.StateSpaceModel(
    lambda x, q, a: [a * x[0] + q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.5]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def model(**changes):
    """Two parameters, of which the data say nothing about the second."""
    simulated = psf.simulate(WALK, {"a": 0.8}, steps=STEPS, random_seed=0)
    observed = simulated["observations"].values.copy()
    for row, value in changes.items():
        observed[int(row.removeprefix("row"))] = value
    with pm.Model() as found:
        a, z = pm.Normal("a", 0.0, 1.0), pm.Normal("z", 0.0, 1.0)
        pm.Deterministic("both", a + z)
        psf.StateSpace("d", WALK, psf.EKF(), steps=STEPS, observed=observed)
    return found


def test_a_start_where_the_density_is_level_is_taken():
    """The mode of a prior, at which nutpie finds no scale."""
    idata = psf.sample(
        1000, sampler="nuts", model=model(), initvals={"a": 0.8, "z": 0.0}, random_seed=1,
        progressbar=False,
    )  # fmt: skip
    z = idata["posterior"]["z"].values
    assert abs(z.mean()) < 5 / np.sqrt(2000)
    assert z.std() == pytest.approx(1.0, abs=0.1)


def test_a_point_of_infinite_gradient_is_not_warned_of():
    frame = Frame(np.zeros(2), np.array([[1.0, 0.0], [0.5, 1.0]]))
    value, gradient = frame.within(lambda x: (-np.inf, np.array([np.inf, -np.inf])))(np.ones(2))
    assert value == -np.inf
    assert not np.isfinite(gradient).any()


@pytest.mark.parametrize("sampler", ["nuts", "dram"])
def test_no_problems_are_found_only_where_the_data_were_not_doubted(sampler, caplog):
    said = []
    for value in (0.3, -999.0):
        if value < 0:
            with pytest.warns(psf.errors.ModelWarning, match="= -999 in row 5"):
                doubted = model(row5=value)
        else:
            doubted = model(row5=value)
        caplog.clear()
        with caplog.at_level(logging.DEBUG, logger="pymc"):
            psf.sample(400, sampler=sampler, model=doubted, random_seed=1, progressbar=False)
        said.append("No problems found" in caplog.text)
    assert said == [True, False]


@pytest.mark.parametrize(("made", "problem"), [(3, "too small to check"), (2000, None)])
def test_an_interrupted_run_says_nothing_of_the_limits_that_it_had(
    made, problem, monkeypatch, caplog
):
    """Not that it ended for want of time, nor how many iterations it would have made."""
    watched = []

    class Watch(chains._Watch):
        def __init__(self):
            super().__init__()
            watched.append(self)

    def is_pressed():
        finished = [chain.finished_draws for chain in watched[-1].chains]
        return bool(finished) and min(finished) >= 300 + made

    monkeypatch.setattr(chains, "_Watch", Watch)
    monkeypatch.setattr(chains, "takes_interrupt", is_pressed)
    monkeypatch.setattr(chains, "convergence", at_most(made, chains.convergence))
    idata = psf.sample(
        10**6, sampler="nuts", model=model(), tune=300, chains=2, random_seed=1, progressbar=False
    )
    assert made <= idata["posterior"].sizes["draw"] < 10**6
    said = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(said) == (problem is not None)
    assert problem is None or problem in said[0]


def at_most(n, convergence):
    """The diagnostics of the first draws, as chains go on until the run looks at them."""
    return lambda positions: convergence([each[:n] for each in positions])


ERRORS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])
EFFECTS = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])
CALL = {"sampler": "nuts", "random_seed": 1, "progressbar": False}


def schools(*, centred):
    with pm.Model() as model:
        mu, tau = pm.Normal("mu", 0, 5), pm.HalfCauchy("tau", 5)
        theta = (
            pm.Normal("theta", mu, tau, shape=8) if centred else mu + tau * pm.Normal("z", shape=8)
        )
        pm.Normal("y", theta, ERRORS, observed=EFFECTS)
    return model


def test_nuts_that_cannot_start_leaves_the_draws_of_the_walk():
    """The posterior, 1 / a for large a, is improper, and the points of the walk are far out."""
    with pm.Model() as model:
        pm.Normal("y", 0.0, pm.HalfFlat("a"), observed=[1.2])
    tree = psf.sample(model=model, random_seed=1, progressbar=False)
    assert tree["posterior"].sizes["draw"] == 1000
    assert tree.attrs["sampler_reason"].startswith("NUTS could not start, as density and gradient")


def test_a_funnel_ends_the_run_at_the_first_doubling_that_does_not_help(caplog):
    tree = psf.sample(150, tune=300, model=schools(centred=True), **CALL)

    assert 2 <= tree.attrs["iterations_per_draw"] <= 32  # of 64
    assert "draws diverged, most where tau is small" in caplog.text
    assert "More iterations do not help draws that diverge: reparametrise tau" in caplog.text
    assert "would do" not in caplog.text  # no number of iterations does


def test_chains_that_do_not_diverge_go_on_however_little_they_gain(monkeypatch):
    monkeypatch.setattr(chains, "_LEAST_GROWTH", 1e6)
    few = {"tune": 300, "until_ess": 395, "max_draws": 400}
    tree = psf.sample(100, model=schools(centred=False), **few, **CALL)
    assert tree.attrs["iterations_per_draw"] > 2
