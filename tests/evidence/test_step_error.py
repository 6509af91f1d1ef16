"""What halving the step changes, against differences of Kalman likelihoods and quadrature."""

from dataclasses import dataclass

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence import Evidence
from pymc_statespace_filters.evidence.shorter_steps import _change, _log_ratio
from pymc_statespace_filters.pymc_model.density import RowFunction
from pymc_statespace_filters.pymc_model.inspection import likelihood_nodes
from pymc_statespace_filters.pymc_model.step_refinement import densities_by_halvings
from pymc_statespace_filters.system.integrators.substeps import CoupledNoise

DT, SIGMA, SENSOR, M0, P0 = 0.2, 0.6, 0.08, 1.0, 0.5
STEPS = np.arange(0, 101, 4)
GRID = np.linspace(1e-3, 6.0, 3001)  # of the rate
LOG_PRIOR = norm.logpdf(GRID) + np.log(2)
RATE = 1e-3  # of right implementations fail each statistical test


def relaxation(substeps=1, dt=DT, **changes):
    """dx = -a x dt + sigma dW."""
    settings = dict(
        transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[SIGMA]], dt=dt, substeps=substeps),
        observation=lambda x: [x[0]],
        observation_noise=[[SENSOR]],
        initial_mean=[M0],
        initial_cov=[[P0]],
    )
    return psf.StateSpaceModel(**settings | changes)


# Simulated with a = 1.
DATA = np.array([
    1.7203, 0.2343, 0.8237, 0.0298, 0.4889, 0.6624, -0.1369, -0.4019, 0.0527, 0.0835, -0.0711,
    0.0671, -0.5401, -0.7121, -0.7768, -0.0412, 0.0487, -0.0912, -0.3837, -0.7239, 0.0449, -0.0745,
    1.4684, -0.5429, -0.3824, 0.6559,
])[:, None]  # fmt: skip


def log_likelihood(a, substeps):
    """Kalman's formulas, with the moments of a step of so many Euler-Maruyama substeps."""
    h = DT / substeps
    growth, shock = 1.0 - np.asarray(a) * h, SIGMA**2 * h
    mean, var, total = np.full(growth.shape, M0), np.full(growth.shape, P0), 0.0
    for j, d in enumerate(DATA[:, 0]):
        total = total + norm.logpdf(d, mean, np.sqrt(var + SENSOR))
        gain = var / (var + SENSOR)
        mean, var = mean + gain * (d - mean), (1 - gain) * var
        if j + 1 < len(STEPS):
            for _ in range(substeps * (STEPS[j + 1] - STEPS[j])):
                mean, var = growth * mean, growth**2 * var + shock
    return total


def log_evidence(substeps):
    return logsumexp(LOG_PRIOR + log_likelihood(GRID, substeps)) + np.log(GRID[1] - GRID[0])


def exact_draws(chains=4, draws=250):
    """Independent draws of the posterior with the model's step."""
    log_density = LOG_PRIOR + log_likelihood(GRID, 1)
    cumulated = np.cumsum(np.exp(log_density - log_density.max()))
    places = np.random.default_rng(1).uniform(size=(chains, draws))
    return np.interp(places, cumulated / cumulated[-1], GRID)


DRAWS = exact_draws()
IDATA = az.from_dict({"posterior": {"a": DRAWS}})


def model_of(filter=None, system=None, steps=STEPS, observed=DATA):
    with pm.Model() as model:
        pm.HalfNormal("a", 1)
        psf.StateSpace("d", system or relaxation(), filter or psf.EKF(), steps=steps,
                       observed=observed)  # fmt: skip
    return model


def test_changes_are_those_of_the_exact_likelihoods_and_evidences():
    table = psf.step_error(IDATA, model_of(), halvings=2, n_draws=DRAWS.size)
    assert list(table.columns) == [
        "log_lik_change", "log_lik_se", "log_evidence_change", "log_evidence_se",
    ]  # fmt: skip
    np.testing.assert_allclose(table.index, [DT / 2, DT / 4])
    for (_, row), substeps in zip(table.iterrows(), (2, 4), strict=True):
        change = log_likelihood(DRAWS, substeps) - log_likelihood(DRAWS, 1)
        np.testing.assert_allclose(row["log_lik_change"], change.mean(), rtol=1e-8)
        np.testing.assert_allclose(row["log_lik_se"], change.std() / DRAWS.size**0.5, rtol=0.15)
        exact = log_evidence(substeps) - log_evidence(1)
        assert abs(row["log_evidence_change"] - exact) < 3.3 * row["log_evidence_se"] < 0.02
    assert len(str(table).splitlines()[0]) <= 80


def test_a_noisy_likelihood_agrees_within_its_standard_error():
    table = psf.step_error(IDATA, model_of(psf.BootstrapPF(100)), random_seed=1)
    row = table.iloc[0]
    # At the same draws, so that only the noise of the filter differs.
    chosen = DRAWS[:, np.linspace(0, 249, 50).round().astype(int)]
    change = (log_likelihood(chosen, 2) - log_likelihood(chosen, 1)).mean()
    assert 0 < abs(row["log_lik_change"] - change) < 3.3 * row["log_lik_se"]
    exact = log_evidence(2) - log_evidence(1)
    assert abs(row["log_evidence_change"] - exact) < 3.3 * row["log_evidence_se"] < 0.05
    again = psf.step_error(IDATA, model_of(psf.BootstrapPF(100)), random_seed=1)
    assert again.equals(table)


def well(substeps=1):
    """Two noises on one state, whose sum a filter would draw with one length of the step only."""
    return relaxation(
        transition=psf.EulerMaruyama(
            lambda x, a: [a * (x[0] - x[0] ** 3)], [[0.6, 0.3]], dt=0.02, substeps=substeps
        )
    )


def test_estimates_with_one_seed_differ_little_and_have_the_models_law():
    """Measured: the standard deviation of the difference is .019, of independent estimates .64."""
    steps, n = np.arange(0, 401, 20), 400
    data = psf.simulate(well(), {"a": 4.0}, steps=steps, random_seed=1)["observations"].values
    filter = psf.BootstrapPF(100)
    model = model_of(filter, well(), steps, data)
    seeds = np.random.default_rng(1).integers(2**62, size=(n, 1))
    coarse, fine = (
        RowFunction(model, graph).evaluate(np.full((n, 1), np.log(4.0)), seeds)
        for graph in densities_by_halvings(model, 1)
    )
    assert np.std(fine - coarse) < 0.2 * np.std(coarse)
    own = psf.log_likelihood(
        well(), filter, {"a": np.full(n, 4.0)}, data, steps=steps, seed=np.arange(n)
    ).sum(axis=-1)
    own = own + model.compile_fn(model.logp(vars=[model["a"]]))({"a_log__": np.log(4.0)})
    ratio, reference = np.exp(coarse - own.max()), np.exp(own - own.max())
    error = np.hypot(ratio.std(), reference.std()) / n**0.5
    assert abs(ratio.mean() - reference.mean()) < norm.isf(RATE / 2) * error


@pytest.mark.parametrize(
    "integrator",
    [
        psf.EulerMaruyama(lambda x, a: [-a * x[0], 0.0], [[0.2, 0.1], [0.0, 0.3]], dt=DT),
        # Another gain in each of three substeps, so that noises of the right places are added.
        psf.EulerMaruyama(
            lambda x, a: [-a * x[0], 0.0],
            lambda t: [[0.2], [1.0 + pt.floor(3.0 * t / DT + 1e-6)]],
            dt=DT,
            substeps=3,
        ),
    ],
)
def test_coupled_steps_move_by_the_sum_of_the_noise_of_fine_steps(integrator):
    """Without drift the second state is the Wiener process itself, whatever the step."""
    base = relaxation(transition=integrator, initial_mean=[0.0, 0.0], initial_cov=np.eye(2))
    systems = [
        base.with_integrator(CoupledNoise(integrator, 4), keeps_noises=True),
        base.with_integrator(CoupledNoise(integrator.refined(), 2), keeps_noises=True),
        base.with_integrator(integrator.refined().refined(), keeps_noises=True),
    ]
    m = {compile_system(system).m for system in systems}
    assert m == {4 * base.m}
    q = np.random.default_rng(1).normal(size=(*m, 1))
    moved = []
    for system in systems:
        machine, x = compile_system(system), np.zeros((2, 1))
        c = machine.prepare.function(np.array([0.3]))
        machine.propagate.function(c, np.zeros((1, 0)), 0, 0.0, q, x)
        moved.append(x[1, 0])
    np.testing.assert_allclose(moved, moved[-1], rtol=1e-12)
    assert systems[0] != base.with_integrator(CoupledNoise(integrator, 4))


def test_a_grid_takes_shorter_steps_where_it_takes_no_substeps():
    """A drift that makes the noise of two substeps not additive; accumulators are reset once."""
    systems = [
        relaxation(
            transition=psf.EulerMaruyama(
                lambda x, a: [a * (x[0] - x[0] ** 3)], [[0.6, 0.3]], dt=dt
            ),
            accumulators=["x0"],
        )
        for dt in (0.02, 0.01)
    ]
    steps = np.arange(0, 41, 10)
    data = psf.simulate(systems[0], {"a": 4.0}, steps=steps, random_seed=1)["observations"].values
    model = model_of(psf.GridFilter(), systems[0], steps, data)
    coarse, fine = densities_by_halvings(model, 1)
    used = [node.op.system for graph in (coarse, fine) for node in likelihood_nodes([graph])]
    assert used == systems
    x = np.log([[4.0], [3.0]])
    found = RowFunction(model, fine).evaluate(x) - RowFunction(model, coarse).evaluate(x)
    before, after = (
        psf.log_likelihood(
            system, psf.GridFilter(), {"a": np.array([4.0, 3.0])}, data, steps=factor * steps
        ).sum(axis=-1)
        for system, factor in zip(systems, (1, 2), strict=True)
    )
    np.testing.assert_allclose(found, after - before, atol=1e-6)


@dataclass(frozen=True)
class Exact:
    """An integrator without an error: its refined version is itself."""

    dt: float = DT

    @property
    def equations(self):
        return psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[SIGMA]], dt=self.dt).equations

    def noise_size(self, values):
        return 1

    def step(self, values):
        a, x, q = values["a"], values["x"], values["q"]
        decay = np.exp(-1.0) ** (a * self.dt)
        return [decay * x[0] + q[0] * SIGMA * ((1 - decay**2) / (2 * a)) ** 0.5]

    def substep(self):
        return self

    def refined(self):
        return self

    def is_stable_at(self, eigenvalues):
        return np.ones(eigenvalues.shape[:-1], dtype=bool)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(20)])
def test_an_exact_integrator_has_no_error(filter):
    model = model_of(filter, relaxation(transition=Exact()))
    table = psf.step_error(IDATA, model, n_draws=80, random_seed=1)
    assert (table.values == 0.0).all()


def test_it_warns_where_few_draws_decide():
    """Draws that are those of another posterior: the likelihood with half the step is elsewhere."""
    far = az.from_dict({"posterior": {"a": np.linspace(0.1, 9.6, 400).reshape(4, 100)}})
    with pytest.warns(EvidenceWarning, match="few draws decide log_evidence_change at dt = 0.1"):
        psf.step_error(far, model_of())


def test_it_warns_of_draws_without_a_likelihood():
    """Steps of 2 / a and more explode over a long gap, shorter ones do not."""
    steps = np.array([0, 4000])
    model = model_of(system=relaxation(dt=0.2), steps=steps, observed=[1.0, 0.1])
    fast = az.from_dict({"posterior": {"a": np.tile(np.linspace(9.0, 12.0, 50), (4, 1))}})
    with pytest.warns(EvidenceWarning, match=r"few draws decide|zero at \d+ of 200 draws") as seen:
        table = psf.step_error(fast, model)
    assert any("the likelihood is zero at" in str(w.message) for w in seen)
    assert np.isfinite(table.values).all()


def test_it_warns_of_estimates_too_noisy_for_eight_seeds():
    data = DATA.copy()
    data[[5, 10, 15, 20]] += 3.0
    model = model_of(psf.BootstrapPF(10), observed=data)
    with pytest.warns(EvidenceWarning, match="too noisy for log_evidence_change at dt = 0.1: the"):
        table = psf.step_error(IDATA, model, random_seed=1)
    assert np.isnan(table["log_evidence_se"].item()) or table["log_evidence_se"].item() > 0


def test_changes_have_no_bias_of_first_order_in_the_seeds():
    """Of independent estimates; the likelihood rises by 0.3 nats at each of two thousand draws."""
    rng = np.random.default_rng(1)
    coarse, fine = rng.normal(-0.02, 0.2, size=(2, 4, 5000, 4))
    found = _change(coarse, fine + 0.3, None)
    plain = np.exp(_log_ratio(coarse, fine + 0.3)).mean()
    assert np.log(plain) - 0.3 > 5 * found.log_evidence_se
    assert abs(found.log_evidence_change - 0.3) < 3.3 * found.log_evidence_se
    louder = _change(coarse, 0.3 + fine + rng.normal(-0.06, 0.35, size=fine.shape), None)
    assert abs(louder.log_lik_change - 0.3) < 3.3 * louder.log_lik_se
    assert abs(louder.log_evidence_change - 0.3) < 3.3 * louder.log_evidence_se


def test_what_it_cannot_treat_is_refused():
    system = psf.StateSpaceModel(
        lambda x, q, a: [a * x[0] + q[0]], process_noise=[[1.0]], observation=lambda x: [x[0]],
        observation_noise=[[1.0]], initial_mean=[0.0], initial_cov=[[1.0]],
    )  # fmt: skip
    with pytest.raises(
        psf.errors.ModelError, match=r"must have .* an integrator, .*got \[StateSpaceMo"
    ):
        psf.step_error(IDATA, model_of(system=system))
    with pytest.raises(
        psf.errors.ModelError, match="halvings must be an integer of at least 1, got 0"
    ):
        psf.step_error(IDATA, model_of(), halvings=0)
    with pytest.raises(
        psf.errors.ModelError, match="n_draws must be an integer of at least 20, got 5"
    ):
        psf.step_error(IDATA, model_of(), n_draws=5)


@pytest.fixture(scope="module", name="table")
def table_of_one_model():
    return psf.step_error(IDATA, model_of())


EVIDENCES = {
    name: Evidence(value, 0.02, "bridge", 1, 26, -10.0, "same")
    for name, value in {"a": -12.0, "b": -13.0}.items()
}


def test_a_comparison_shows_it_as_a_column(table):
    compared = psf.compare_evidence(EVIDENCES, step_errors={"b": table})
    row = table.iloc[0]
    assert compared.loc["b", "step_error"] == row["log_evidence_change"]
    assert compared.loc["b", "step_error_se"] == row["log_evidence_se"]
    lines = repr(compared).splitlines()
    assert lines[0].split()[-1] == "step_error"
    assert [line.split()[-1] for line in lines[2:4]] == ["unknown", f"{row.iloc[2]:.3f}"]
    assert max(map(len, lines)) <= 80
    said = " ".join(repr(compared).split())
    assert f"log-evidence of 'b' is lower by {-row.iloc[2]:.2g}, and se excludes that" in said
    plain = psf.compare_evidence(EVIDENCES)
    assert "step_error" not in plain
    assert "With half the" not in repr(plain)


def test_a_comparison_refuses_what_is_no_table(table):
    message = r"evidences hold neither draws nor equations; got True for the models \['a', 'b'\]"
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.compare_evidence(EVIDENCES, step_errors=True)
    with pytest.raises(
        psf.errors.ModelError, match=r"step_errors\['a'\] must be a table of psf.step"
    ):
        psf.compare_evidence(EVIDENCES, step_errors={"a": 0.1})
    with pytest.raises(psf.errors.ModelError, match=r"got \['c'\] for the models"):
        psf.compare_evidence(EVIDENCES, step_errors={"c": table})
