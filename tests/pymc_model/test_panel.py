"""`StateSpace(panel=)`: the log-density, gradient and draws of many records in one variable."""

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.numerics.philox import seed_of_record
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.observed_data import (
    observation_count,
    observed_in,
    scalar_count,
)
from pymc_statespace_filters.pymc_model.step_refinement import densities_by_halvings
from pymc_statespace_filters.system.panel_records import records_of
from tests.systems import FORCE, FORCED, forced_terms

pytestmark = pytest.mark.usefixtures("interpreted")

LABELS = np.array(["b", "b", "b", "a", "c", "c"])
STEPS = np.array([0, 2, 5, 3, 1, 4])
DATA = np.array([[0.1], [np.nan], [0.8], [-0.4], [0.9], [0.2]])
A = np.array([0.9, -0.3, 0.5])
RECORDS = records_of(LABELS)
PARTICLES = psf.BootstrapPF(64)
OWN_FORCES = {"a": FORCE[::-1].copy(), "b": FORCE, "c": 2 * FORCE}


def model_of(filter=None, panel=LABELS, steps=STEPS, observed=DATA, own=3, **options):
    options = {"inputs": FORCE} | options
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 1.0)
        pm.Normal("a", mu, 0.5, shape=own)
        psf.StateSpace(
            "d", FORCED, filter or psf.EKF(), panel=panel, steps=steps, observed=observed, **options
        )
    return model


def terms_of(model, a=A):
    (terms,) = model.compile_logp([model["d"]], sum=False)({"mu": 0.2, "a": a})
    return terms


def exact_terms(a=A):
    parts = [
        forced_terms(a[g], DATA[rows], STEPS[rows], FORCE)
        for g, rows in enumerate(RECORDS.slices())
    ]
    return np.concatenate(parts)


def test_terms_are_those_of_kalman_filters_of_each_record():
    np.testing.assert_allclose(terms_of(model_of()), exact_terms(), rtol=1e-12)


def test_the_gradient_is_that_of_the_sum_for_own_and_for_shared_parameters():
    h, model = 1e-5, model_of()
    gradient = model.compile_dlogp([model["mu"], model["a"]])({"mu": 0.2, "a": A})
    steps = h * np.eye(3)
    slopes = [(exact_terms(A + s).sum() - exact_terms(A - s).sum()) / (2 * h) for s in steps]
    np.testing.assert_allclose(gradient[1:] + (A - 0.2) / 0.25, slopes, rtol=1e-7)
    with pm.Model() as shared:
        pm.Normal("a", 0.0, 1.0)
        psf.StateSpace(
            "d", FORCED, psf.EKF(), panel=LABELS, steps=STEPS, observed=DATA, inputs=FORCE
        )
    one = np.full(3, 0.5)
    slope = (exact_terms(one + h).sum() - exact_terms(one - h).sum()) / (2 * h)
    np.testing.assert_allclose(shared.compile_dlogp()({"a": 0.5}) + 0.5, slope, rtol=1e-7)


def test_each_record_has_the_noise_of_its_label():
    terms = terms_of(model_of(PARTICLES, seed=3, inputs=OWN_FORCES))
    for g, rows in enumerate(RECORDS.slices()):
        alone = psf.log_likelihood(
            FORCED,
            PARTICLES,
            {"a": A[g]},
            DATA[rows],
            steps=STEPS[rows],
            inputs=OWN_FORCES[RECORDS.labels[g]],
            seed=int(seed_of_record(3, RECORDS.codes[g])),
        )
        np.testing.assert_array_equal(terms[rows], alone)


@pytest.mark.parametrize("filter", [psf.EKF(), PARTICLES])
def test_permuted_records_give_permuted_terms(filter):
    order = np.array([3, 4, 5, 0, 1, 2])
    permuted = model_of(filter, LABELS[order], STEPS[order], DATA[order])
    found = terms_of(permuted, A[[1, 2, 0]])
    np.testing.assert_array_equal(found, terms_of(model_of(filter))[order])


@pytest.mark.parametrize("filter", [psf.EKF(), PARTICLES])
def test_the_record_labelled_0_has_the_bits_of_a_variable_without_a_panel(filter):
    record = {"observed": DATA[:3], "steps": STEPS[:3], "inputs": FORCE, "seed": 9}
    alone = psf.log_likelihood(FORCED, filter, {"a": 0.9}, **record)
    in_panel = psf.log_likelihood(FORCED, filter, {"a": 0.9}, panel=[0, 0, 0], **record)
    np.testing.assert_array_equal(in_panel, alone)


def test_the_noise_of_neighbouring_labels_and_seeds_differs():
    seeds = {int(seed_of_record(seed, code)) for seed in range(50) for code in range(-25, 25)}
    assert len(seeds) == 2500
    assert min(seeds) >= 0
    assert all(seed_of_record(seed, 0) == seed for seed in (0, 5, 2**62))


def test_own_inputs_are_those_of_the_record():
    expected = np.concatenate(
        [
            forced_terms(A[g], DATA[rows], STEPS[rows], OWN_FORCES[label])
            for g, (label, rows) in enumerate(zip(RECORDS.labels, RECORDS.slices(), strict=True))
        ]
    )
    np.testing.assert_allclose(terms_of(model_of(inputs=OWN_FORCES)), expected, rtol=1e-12)
    shared = {label: pt.as_tensor(force) for label, force in OWN_FORCES.items()}
    np.testing.assert_allclose(terms_of(model_of(inputs=shared)), expected, rtol=1e-12)


def test_the_first_rows_of_every_record_are_not_scored():
    expected = exact_terms()
    expected[[0, 3, 4]] = 0.0
    np.testing.assert_allclose(terms_of(model_of(score_from=1)), expected, rtol=1e-12)
    assert observation_count(observed_in(model_of())) == 5
    # Without the first row of each record and the row that is missing.
    later = observed_in(model_of(score_from=1))
    assert observation_count(later) == scalar_count(later) == 2
    with pytest.raises(ModelError, match="score_from must be an integer from 0 to 2"):
        model_of(score_from=3)


def test_draws_are_simulations_of_each_record():
    model = model_of(observed=None, inputs=OWN_FORCES)
    steady = pm.do(model, {"a": np.array([0.0, 0.5, 0.9])})
    draws = pm.draw(steady["d"], draws=4000, random_seed=1)[:, :, 0]
    # Without memory the state is the last force plus noise; sensor and process noise add up.
    np.testing.assert_allclose(draws[:, 1].mean(), FORCE[1], atol=0.08)  # 4 s.e.
    recursion = 0.25 * FORCE[5] + 0.5 * FORCE[4] + FORCE[3]  # of record a: its forces are reversed
    np.testing.assert_allclose(draws[:, 3].mean(), recursion, atol=0.09)
    np.testing.assert_allclose(draws[:, 1].var(), 1.5, atol=0.14)
    assert abs(np.corrcoef(draws[:, 4], draws[:, 5])[0, 1]) > 0.3
    assert abs(np.corrcoef(draws[:, 2], draws[:, 5])[0, 1]) < 0.07


def test_dimensions_coordinates_and_data_name_record_and_time():
    model = model_of(t0=2.0)
    assert model.named_vars_to_dims["d"] == ("d_obs", "observable")
    assert model.coords["d_record"] == ("b", "a", "c")
    assert model["d_panel"].get_value().tolist() == [0, 0, 0, 1, 2, 2]
    np.testing.assert_array_equal(model["d_time"].get_value(), 2.0 + STEPS)
    numbered = model_of(panel=[5, 5, 5, 9, 2, 2])
    assert numbered["d_panel"].get_value().tolist() == [5, 5, 5, 9, 2, 2]


def test_data_can_be_replaced_by_rows_of_another_number():
    with pm.Model() as model:
        a = pm.Normal("a", 0.0, 1.0)
        codes = pm.Data("codes", [1, 1, 1, 2, 3, 3], dims="row")
        steps, observed = pm.Data("steps", STEPS, dims="row"), pm.Data("y", np.zeros((6, 1)))
        psf.StateSpace(
            "d", FORCED, psf.EKF(), panel=codes, steps=steps, observed=observed, inputs=FORCE,
            dims=("row", "observable"),
        )  # fmt: skip
    density = model.compile_logp([model["d"]], sum=False)
    assert density({"a": 0.5})[0].shape == (6,)
    with model:
        new = {"codes": [4, 4, 9, 7], "steps": [0, 1, 3, 5], "y": np.ones((4, 1))}
        pm.set_data(new, coords={"row": range(4)})
    parts = [slice(0, 2), slice(2, 3), slice(3, 4)]
    ones, at = np.ones((4, 1)), np.array(new["steps"])
    expected = [forced_terms(0.5, ones[rows], at[rows], FORCE) for rows in parts]
    np.testing.assert_allclose(density({"a": 0.5})[0], np.concatenate(expected), rtol=1e-12)
    with model:
        pm.set_data({"steps": [1, 0, 3, 5]}, coords={"row": range(4)})
    with pytest.raises(ModelError, match="increase strictly within a record"):
        density({"a": 0.5})
    assert a.name == "a"


def test_own_parameters_of_another_number_of_records_are_refused():
    with pytest.raises(ModelError, match=r"'a' must have shape \(\).* or \(3,\).*got \(2,\)"):
        model_of(own=2)
    with pm.Model() as model:
        pm.Normal("a", 0.0, 1.0, shape=3)
        codes, steps = pm.Data("codes", [1, 1, 1, 2, 3, 3]), pm.Data("steps", STEPS)
        psf.StateSpace(
            "d", FORCED, psf.EKF(), panel=codes, steps=steps, inputs=FORCE,
            observed=pm.Data("y", np.zeros((6, 1))),
        )  # fmt: skip
        density = model.compile_logp()
        pm.set_data({"codes": [1, 1, 1], "steps": [0, 1, 2], "y": np.ones((3, 1))})
    with pytest.raises(ModelError, match="'a' must have a value for each record"):
        density({"a": A})


def test_batches_of_parameters_are_batches_of_panels():
    model = model_of()
    many = np.stack([A, A + 0.1])
    value = model.rvs_to_values[model["d"]]
    theta = pt.as_tensor(many[:, :, None])
    rows = model["d"].owner.inputs[3]
    batch = psf.StateSpace.dist(
        theta, rows, FORCE[:, None], 0.0, 0, system=FORCED, filter=psf.EKF()
    )
    terms = pm.logp(batch, np.stack([DATA, DATA])).eval()
    np.testing.assert_allclose(terms, [exact_terms(a) for a in many], rtol=1e-12)
    assert value.type.ndim == 2


def test_steps_half_as_long_are_those_of_every_record():
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x, u, a: [-a * x[0] ** 3 + u[0]], [[0.5]], dt=0.25),
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[1.0],
        initial_cov=[[0.2]],
        inputs=["force"],
    )

    def finest(rows, **options):
        with pm.Model() as model:
            pm.Normal("a", 1.0, 1.0)
            record = {"steps": STEPS[rows], "observed": DATA[rows], "inputs": FORCE}
            psf.StateSpace("d", system, psf.EKF(), **record, **options)
        graph = densities_by_halvings(model, 1)[-1]
        return model.compile_fn(graph - model.logp([model["a"]]), point_fn=False)(0.7)

    alone = [finest(rows) for rows in RECORDS.slices()]
    np.testing.assert_allclose(finest(slice(None), panel=LABELS), sum(alone), rtol=1e-12)


def test_a_record_never_seen_has_parameters_of_the_population():
    """Its mean and variance at step 1 by hand, within 5 standard errors of 8000 draws."""
    mu = 0.6
    idata = az.from_dict({"posterior": {"mu": np.full((4, 2000), mu)}})
    with pm.Model():
        population = pm.Flat("mu")
        a = pm.Normal("new_a", population, 0.5)
        psf.StateSpace("new", FORCED, psf.EKF(), steps=[1], inputs=FORCE, params={"a": a})
        found = pm.sample_posterior_predictive(
            idata, var_names=["new"], predictions=True, random_seed=1, progressbar=False
        )
    drawn = found["predictions"]["new"].values.ravel()
    # x1 = a x0 + u0 + q, seen with noise: E[a^2] times 1, and 1 and 0.5.
    variance = mu**2 + 0.25 + 1.0 + 0.5
    fourth = 3 * ((mu**4 + 6 * mu**2 * 0.25 + 3 * 0.0625) + 2 * 1.5 * (mu**2 + 0.25) + 2.25)
    assert abs(drawn.mean() - FORCE[0]) < 5 * np.sqrt(variance / drawn.size)
    assert abs(drawn.var() - variance) < 5 * np.sqrt((fourth - variance**2) / drawn.size)
