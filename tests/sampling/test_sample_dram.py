"""``sample_dram`` as a user meets it: its draws, its tree, its errors, its warnings."""

import re
import threading
import time
from types import SimpleNamespace

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
import xarray as xr
from pytensor.compile.ops import wrap_py

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import ended_dram
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling import DRAM
from tests.interrupts import interrupt_chains
from tests.kernels import with_kernel
from tests.modes import AS_IT_STANDS
from tests.sampling.test_dram import assert_moments, sample, simple_model
from tests.sampling.test_results import assert_same, rich_model
from tests.systems import autoregression

LOGGER = "pymc.stats.convergence"


def sample_dram(model, **changes):
    settings = {
        "draws": 200,
        "tune": 200,
        "chains": 2,
        "cores": 2,
        "random_seed": 1,
        "progressbar": False,
    }
    return psf.sample_dram(model=model, **with_kernel(settings | changes))


SYSTEM = autoregression(spread=0.5**0.5)
STEPS = np.arange(1, 9)
DATA = np.array([[0.3, 0.5, -0.1, 0.4, 0.9, 0.2, -0.3, 0.1]]).T


def state_space_model(*filters):
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.3)
        for i, filter in enumerate(filters):
            psf.StateSpace(f"d{i}", SYSTEM, filter, steps=STEPS, observed=(-1) ** i * DATA)
    return model


@pytest.fixture(scope="module")
def noisy():
    """A model with two records, one likelihood estimated."""
    return state_space_model(psf.BootstrapPF(20), psf.EKF())


def assert_identical(found, expected):
    """The same draws and statistics, to the bit."""
    assert set(found.children) == set(expected.children)
    for group in expected.children:
        xr.testing.assert_identical(
            found[group].to_dataset().drop_attrs(), expected[group].to_dataset().drop_attrs()
        )


# What is drawn.


def test_the_law_of_a_conjugate_model():
    """Mean and variance unknown; 4.5 standard errors, 7e-6 a comparison, four comparisons."""
    data = np.array([1.2, 0.7, 2.9, 1.8, 1.1, 0.4])
    with pm.Model() as model:
        precision = pm.Gamma("precision", 3.0, 2.0)
        mu = pm.Normal("mu", 0.5, (2.0 / precision) ** 0.5)
        pm.Normal("y", mu, precision**-0.5, observed=data)
    tree = sample_dram(model, draws=8000, tune=1000, compute_convergence_checks=False)
    n, k = len(data), 0.5
    a = 3.0 + n / 2
    b = 2.0 + 0.5 * n * data.var() + 0.5 * k * n / (k + n) * (data.mean() - 0.5) ** 2
    mean = (k * 0.5 + data.sum()) / (k + n)
    posterior = tree["posterior"]
    assert_moments(posterior["precision"].to_numpy(), a / b, a**0.5 / b)
    assert_moments(posterior["mu"].to_numpy(), mean, (b / ((a - 1) * (k + n))) ** 0.5)


def test_draws_depend_on_the_seed_alone(noisy):
    first = sample_dram(noisy, chains=4, cores=1)
    for cores in (2, 9, None):
        assert_identical(sample_dram(noisy, chains=4, cores=cores), first)
    other = sample_dram(noisy, chains=4, random_seed=2)
    chains = [*first["posterior"]["phi"].to_numpy(), *other["posterior"]["phi"].to_numpy()]
    assert len(np.unique(chains, axis=0)) == 8


def test_generators_are_seeds():
    model, rng = simple_model(), np.random.default_rng(3)
    first, second = sample_dram(model, random_seed=rng), sample_dram(model, random_seed=rng)
    assert_identical(sample_dram(model, random_seed=np.random.default_rng(3)), first)
    assert not np.array_equal(first["posterior"]["mu"], second["posterior"]["mu"])
    unseeded = [sample_dram(model, random_seed=None)["posterior"]["mu"] for _ in range(2)]
    assert not np.array_equal(*unseeded)


def test_a_chain_is_the_same_among_more_chains_until_they_share_a_mixture():
    model, settings = simple_model(), {"tune": 400, "discard_tuned_samples": False}
    two, three = (sample_dram(model, chains=chains, **with_kernel(settings)) for chains in (2, 3))
    mine, theirs = (tree["warmup_posterior"]["mu"].values[:2] for tree in (two, three))
    np.testing.assert_array_equal(mine[:, :100], theirs[:, :100])
    assert (mine[:, 100:200] != theirs[:, 100:200]).any(axis=1).all()


def test_data_changed_between_runs():
    with pm.Model() as model:
        data = pm.Data("data", [10.0])
        pm.Normal("y", pm.Normal("mu", 0, 100), 0.1, observed=data)
    before = sample_dram(model, tune=500)["posterior"]["mu"].mean()
    pm.set_data({"data": [-10.0, -10.0]}, model=model)
    after = sample_dram(model, tune=500)
    np.testing.assert_allclose([before, after["posterior"]["mu"].mean()], [10, -10], atol=0.1)
    np.testing.assert_array_equal(after["constant_data"]["data"], [-10.0, -10.0])


# The tree.


@pytensor.config.change_flags(mode=AS_IT_STANDS)
def two_trees(model, **changes):
    """By ``sample_dram`` and by ``pm.sample``, which do not draw the same numbers."""
    mine = sample_dram(model, draws=30, tune=20, **with_kernel(changes))
    with model:
        return mine, sample(DRAM(), draws=30, tune=20, **changes)


def without_values(tree):
    """All of a tree but its numbers, and the states of the chains."""
    return xr.DataTree.from_dict(
        {
            name: xr.zeros_like(group.to_dataset())
            if name.removeprefix("warmup_") in ("posterior", "sample_stats")
            else group.to_dataset()
            for name, group in tree.children.items()
            if name != "sampler_state"
        }
    )


def test_a_tree_as_of_pm_sample():
    mine, expected = two_trees(rich_model(), discard_tuned_samples=False)
    assert_same(without_values(mine), without_values(expected))
    assert "warmup_posterior" in mine.children


def test_a_tree_as_of_pm_sample_with_several_records(noisy):
    mine, expected = two_trees(noisy)
    assert_same(without_values(mine), without_values(expected))
    assert "warmup_posterior" not in mine.children
    assert {"d0_seed", "n_effective"} < set(mine["sample_stats"].data_vars)
    assert mine["sample_stats"]["exact"].all()


@pytest.mark.filterwarnings("ignore:the terms of a StateSpace variable")
@pytest.mark.filterwarnings("ignore:log-evidence .* the chains disagree")  # short ones
@pytensor.config.change_flags(mode=AS_IT_STANDS)
def test_what_is_done_with_a_tree(noisy, tmp_path):
    tree = sample_dram(noisy, draws=400, tune=300)
    with noisy:
        pm.compute_log_likelihood(tree, var_names=["d1"], progressbar=False)
        predicted = pm.sample_posterior_predictive(
            tree, var_names=["d0"], progressbar=False, random_seed=1
        )
    assert tree["log_likelihood"]["d1"].shape[:2] == (2, 400)
    assert predicted["posterior_predictive"]["d0"].shape == (2, 400, 8, 1)
    assert 0.2 < float(az.summary(tree, round_to="none").loc["phi", "mean"]) < 0.6
    assert az.rhat(tree)["phi"] < 1.1
    assert az.ess(tree)["phi"] > 30
    az.plot_trace_dist(tree)
    evidence = psf.chib_jeliazkov(tree, noisy, random_seed=1, progressbar=False)
    assert np.isfinite(evidence.log_evidence)
    tree.to_netcdf(tmp_path / "tree.nc")
    with xr.open_datatree(tmp_path / "tree.nc") as again:
        np.testing.assert_array_equal(again["posterior"]["phi"], tree["posterior"]["phi"])
        assert again.attrs == tree.attrs


def test_stored_estimates_are_those_of_their_seeds(noisy):
    stats = (tree := sample_dram(noisy))["sample_stats"]
    logp = noisy.compile_logp()
    (seed,) = [v for v in logp.f.get_shared() if v.name == "d0_seed"]
    for draw in range(0, 200, 40):
        seed.set_value(stats["d0_seed"][1, draw].to_numpy())
        at = {"phi": tree["posterior"]["phi"][1, draw].to_numpy()}
        np.testing.assert_allclose(logp(at), stats["lp"][1, draw], rtol=1e-12)


# What cannot be sampled.


def test_models_that_cannot_be_sampled():
    with pm.Model() as discrete:
        pm.Normal("a")
        pm.Poisson("n", 3.0)
    with pytest.raises(ModelError, match=r"discrete: n\. .* pm\.sample\(step=\[DRAM\(\[\.\.\.\]\)"):
        sample_dram(discrete)
    with pm.Model() as fixed:
        pm.Normal("y", 0, 1, observed=[1.0])
    with pytest.raises(ModelError, match="at least one free variable"):
        sample_dram(fixed)
    with pm.Model() as empty:
        pm.Normal("y", 0, 1, shape=0)
    with pytest.raises(ModelError, match="at least one free variable"):
        sample_dram(empty)
    with pm.Model() as drawing:
        mu = pm.Normal("mu")
        pm.Normal("y", mu, 1, observed=pm.Minibatch(np.arange(9.0), batch_size=3), total_size=9)
    with pytest.raises(ModelError, match=r"'y' draws random numbers from a generator"):
        sample_dram(drawing)
    with pytest.raises(ModelError, match=r"outside a `with` block of a model, as model=m"):
        psf.sample_dram()


def test_frozen_models(noisy):
    freeze = pm.model.transform.optimization.freeze_dims_and_data
    with pytest.raises(ModelError, match=r"seed of 'd0' must be shared data"):
        sample_dram(freeze(noisy))
    exact = state_space_model(psf.EKF())
    assert_identical(sample_dram(freeze(exact)), sample_dram(exact))


def test_starting_values():
    model, still = simple_model(), {"draws": 4, "tune": 4, "proposal_cov": 1e-20 * np.eye(2)}
    for_all = sample_dram(model, initvals={"mu": 7.0}, **with_kernel(still))["posterior"]
    np.testing.assert_allclose(for_all["mu"], 7.0, atol=1e-6)
    each = sample_dram(model, initvals=[{"mu": 7.0}, {model["sigma"]: 3.0}], **with_kernel(still))[
        "posterior"
    ]
    np.testing.assert_allclose(each["mu"][:, 0], [7.0, model.initial_point()["mu"]], atol=1e-6)
    np.testing.assert_allclose(each["sigma"][1], 3.0, atol=1e-6)
    dispersed = sample_dram(model, **with_kernel(still))["posterior"]["mu"]
    assert len(np.unique(dispersed[:, 0])) == 2


# What happens on the way.


class Watched:
    """A log-density in Python that counts its calls, and sleeps or raises when told to."""

    def __init__(self):
        self.calls, self.threads = 0, set()
        self.seconds, self.last = 0.0, np.inf

        @wrap_py([pt.dscalar], [pt.dscalar])
        def watched(mu):
            self.calls += 1
            self.threads.add(threading.get_ident())
            time.sleep(self.seconds)
            if self.calls > self.last:
                raise ArithmeticError("no more")
            return np.asarray(-(mu**2))

        with pm.Model() as self.model:
            pm.Potential("watched", watched(pm.Normal("mu")))


@pytest.fixture
def watched():
    return Watched()


in_python = pytest.mark.filterwarnings("ignore:Numba will use object mode")


@in_python
@pytest.mark.parametrize("mode", ["NUMBA", "FAST_COMPILE"])
def test_operations_without_machine_code(watched, mode):
    with pytensor.config.change_flags(mode=mode):
        two, one = (sample_dram(watched.model, draws=300, cores=cores) for cores in (2, 1))
        assert_identical(two, one)
        assert len(watched.threads) >= 3  # both threads, and here
        # Its errors come out, name the chain, and stop the others and those that wait.
        watched.calls, watched.last, watched.seconds = 0, 300, 0.001
        for cores in (1, 2):
            watched.calls = 0
            with pytest.raises(ArithmeticError, match="no more") as caught:
                sample_dram(watched.model, draws=10**6, chains=3, cores=cores, initvals={})
            assert re.fullmatch(r"in chain \d, after \d+ iterations", caught.value.__notes__[-1])
            assert watched.calls < 900
        # And leave nothing behind.
        watched.last, watched.seconds = np.inf, 0.0
        assert_identical(sample_dram(watched.model, draws=300), one)


@in_python
def test_an_error_at_the_start(watched):
    watched.last = 3
    with pytest.raises(ArithmeticError) as caught:
        sample_dram(watched.model, initvals={})
    assert caught.value.__notes__[-1].endswith("after 0 iterations")
    watched.calls = 0
    with pytest.raises(ArithmeticError) as caught:
        sample_dram(watched.model)
    assert caught.value.__notes__[-1] == "in the search for starts"


def test_a_record_that_became_wrong():
    with pm.Model() as model:
        record = pm.Data("record", DATA)
        phi = pm.Normal("phi", 0.5, 0.3)
        steps = pm.Data("steps", STEPS)
        psf.StateSpace("d", SYSTEM, psf.EKF(), steps=steps, observed=record, params={"phi": phi})
    sample_dram(model, draws=5, tune=5)
    pm.set_data({"steps": STEPS[::-1]}, model=model)
    with pytest.raises(ModelError, match="steps"):
        sample_dram(model, draws=5, tune=5)


@in_python
@pytest.mark.usefixtures("interrupts_arrive")
@pytest.mark.parametrize(("presses", "tune"), [(1, 20), (3, 0)])
def test_an_interrupt_returns_what_is_there(watched, monkeypatch, presses, tune):
    """Also where a chain waits for its turn, and somebody is impatient."""
    interrupt_chains(monkeypatch, after=tune + 1, presses=presses)
    tree = sample_dram(
        watched.model, draws=10**7, tune=tune, chains=3, cores=2, discard_tuned_samples=False
    )
    assert tree["posterior"].sizes["chain"] == 2
    assert tree["posterior"].sizes["draw"] >= 1
    assert ("warmup_posterior" in tree.children) == (tune > 0)
    assert tune == 0 or tree["warmup_posterior"].sizes["draw"] == tune


@pytest.mark.parametrize(
    ("lengths", "skipped", "said"),
    [
        ((30, 30, 30), 20, None),
        ((0, 0, 0), 0, None),  # which is an error
        (
            (30, 29, 0),
            20,
            "2 of 3 chains, with 9 iterations of each. It lacks the others: chain 2 ",
        ),
        ((5, 90, 0), 0, "1 of 3 chains, with 90 iterations of each. It lacks the others: chain 0 "),
    ],
)
def test_chains_left_out_are_named(lengths, skipped, said):
    fact = SimpleNamespace(lengths=lengths, request=SimpleNamespace(n_skipped=skipped))
    texts = ended_dram._left_out(fact)
    assert [said in text for text in texts] == [True] * (said is not None)
    if said is not None:
        assert texts[0].endswith("chain 2 had not begun.")


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_names_the_chains_that_had_not_begun(monkeypatch, caplog):
    interrupt_chains(monkeypatch, after=3)
    tree = sample_dram(simple_model(), draws=10**5, tune=0, chains=4, cores=2)
    assert tree["posterior"].sizes["chain"] == 2
    (said,) = [r.message for r in caplog.records if "interrupted" in r.message]
    assert "of 4 chains" in said
    assert said.endswith("chain 2 had not begun, chain 3 had not begun.")


@pytest.mark.parametrize("asked", [True, False])
def test_convergence_is_judged_if_it_is_asked_for(asked, caplog):
    """What the chains have met is said in any case."""
    caplog.set_level("INFO", LOGGER)
    call = {"tune": 0, "compute_convergence_checks": asked}
    sample_dram(simple_model(), draws=99, **call)
    assert ("until_ess=200 does it" in caplog.text) == asked
    sample_dram(
        simple_model(), draws=100, **with_kernel({"proposal_cov": 1e12 * np.eye(2)}), **call
    )
    assert caplog.text.count("Chains 0 and 1: DRAM accepted 0 of 100") == 1


@pytest.mark.parametrize(
    "last", ["sampling.run.model_result.spread_at_highest_draw", "advice.filter_check._check"]
)
def test_an_interrupt_after_the_last_draw_keeps_all(noisy, monkeypatch, last):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    expected = sample_dram(noisy, draws=300, tune=300)
    monkeypatch.setattr(f"pymc_statespace_filters.{last}", interrupted)
    found = sample_dram(noisy, draws=300, tune=300)
    assert found["posterior"].equals(expected["posterior"])
