"""Fields at draws of their coefficients, against the closed form of a Bayesian regression."""

import json
import re
from contextlib import nullcontext

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError, ModelWarning

DT, NOISE, LENGTH, AMPLITUDE = 0.1, 0.5, 1.0, 1.5
BASIS = psf.mechanics.gaussian_process_terms("z", (-2, 2), 6)
PAIR = psf.mechanics.gaussian_process_terms(["w", "v"], [(-1, 1), (-2, 2)], (3, 2))
POLYNOMIALS = psf.mechanics.polynomial_terms(["w", "v"], 2)
N_DRAWS = 4000


def sines(states, box, n):
    """The functions (n, ...) of one state, written from their definition."""
    low, high = np.mean(box) + 1.5 * (np.array(box) - np.mean(box))
    j = np.arange(1, n + 1).reshape(-1, *[1] * np.ndim(states))
    return np.sqrt(2 / (high - low)) * np.sin(np.pi * j * (states - low) / (high - low))


def of_one_state(basis=BASIS, states=("z",), noise=NOISE, length=LENGTH):
    """A record of a double well, seen with hardly any noise; its field and friction unknown."""
    system = psf.StateSpaceModel(
        states=list(states),
        transition=lambda x, q, c: [x[0] + DT * (c @ basis(x)) + noise * np.sqrt(DT) * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[1e-12]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        shapes={"c": (len(basis),)},
    )
    with pm.Model() as model:
        if length is None:
            length = pm.HalfNormal("length", 2.0)
        elif length == "of_each_state":
            model.add_coord("state", states)
            length = pm.HalfNormal("length", 2.0, dims="state")
        pm.Normal("c", 0, basis.prior_sd(length, AMPLITUDE), shape=len(basis))
        psf.StateSpace("d", system, psf.EKF(), steps=np.arange(len(RECORD)), observed=RECORD)
    return model


def recorded():
    rng, x = np.random.default_rng(1), [1.0]
    for _ in range(400):
        x.append(x[-1] + DT * (x[-1] - x[-1] ** 3) + NOISE * np.sqrt(DT) * rng.normal())
    return np.array(x)


RECORD = recorded()


def regression(record, noise=NOISE):
    """The posterior mean and covariance of the coefficients, which increments are linear in."""
    design = DT * sines(record[:-1], (-2, 2), 6).T
    prior = np.diag(BASIS.prior_sd(LENGTH, AMPLITUDE).eval() ** -2.0)
    cov = np.linalg.inv(design.T @ design / (noise**2 * DT) + prior)
    return cov @ design.T @ np.diff(record) / (noise**2 * DT), cov


def draws_of(mean, cov, seed=2):
    drawn = np.random.default_rng(seed).multivariate_normal(mean, cov, N_DRAWS)
    return az.from_dict({"posterior": {"c": drawn.reshape(4, -1, len(mean))}})


@pytest.fixture(scope="module")
def model():
    return of_one_state()


@pytest.fixture(scope="module")
def found(model):
    """Without a warning: the record tells much of this field, and stays where it is defined."""
    return psf.field(
        draws_of(*regression(RECORD)), model, terms={"c": BASIS}, ci_prob=0.8, random_seed=3
    )["c"]


def test_moments_and_bands_are_those_of_the_regression(found):
    """4 Monte Carlo errors, at all points: false in fewer than one of a hundred runs."""
    mean, cov = regression(RECORD)
    z = np.linspace(-2, 2, 101)
    np.testing.assert_allclose(found["z"], z)
    terms = sines(z, (-2, 2), 6)
    exact, sd = mean @ terms, np.sqrt(np.einsum("in,ij,jn->n", terms, cov, terms))
    assert (abs(found["mean"] - exact) < 4 * sd / np.sqrt(N_DRAWS)).all()
    assert (abs(found["sd"] / sd - 1) < 4 / np.sqrt(2 * N_DRAWS)).all()
    for end, probability in (("low", 0.1), ("high", 0.9)):
        place = norm.ppf(probability)
        error = sd * np.sqrt(0.1 * 0.9 / N_DRAWS) / norm.pdf(place)
        assert (abs(found[end] - exact - place * sd) < 4 * error).all()
    positive = norm.cdf(exact / sd)
    error = np.sqrt(positive * (1 - positive) / N_DRAWS)
    assert (abs(found["prob_positive"] - positive) < 4 * error + 1 / N_DRAWS).all()
    before = np.sqrt(BASIS.prior_sd(LENGTH, AMPLITUDE).eval() ** 2 @ terms**2)
    assert (abs(found["prior_sd"] / before - 1) < 4 / np.sqrt(1000)).all()


def test_visited_states_are_those_of_the_record(found):
    assert found.attrs["doubts"] == ""
    visited = found["visited"].sel(visited_state="z").values.reshape(-1, len(RECORD))
    np.testing.assert_allclose(visited, np.tile(RECORD, (len(visited), 1)), atol=1e-5)
    distance = abs(RECORD - np.linspace(-2, 2, 101)[:, None])
    near = (distance <= BASIS.shortest_length).mean(axis=1)
    np.testing.assert_allclose(found["near"], near, atol=0.005)
    assert 0 < near.min() < 0.01 < near.max()


def of_two_states(c):
    system = psf.StateSpaceModel(
        states=["u", "v", "w"],
        transition=lambda x, q, c, b: [
            x[0] + 0.1 * (c @ PAIR([x[2], x[1]])) + 0.1 * (b @ POLYNOMIALS([x[2], x[1]])) + q[2],
            0.9 * x[1] + q[0],
            0.5 * x[2] + 0.1 * q[1],
        ],
        process_noise=np.eye(3),
        observation=lambda x: x,
        observation_noise=1e-12 * np.eye(3),
        initial_mean=np.zeros(3),
        initial_cov=np.eye(3),
        shapes={"c": (len(PAIR),), "b": (len(POLYNOMIALS),)},
    )
    with pm.Model() as model:
        z = pm.Normal("z", shape=len(PAIR))
        pm.Deterministic("c", PAIR.prior_sd(3.0, 1.0) * z)
        pm.Flat("b", shape=len(POLYNOMIALS))
        psf.StateSpace("d", system, psf.EKF(), steps=np.arange(len(RECORD_3)), observed=RECORD_3)
    b = np.full((2, 3, len(POLYNOMIALS)), [0.0, 0.0, 0.0, 0.0, 1.0, -2.0])  # w v - 2 v^2
    idata = az.from_dict({"posterior": {"z": np.zeros((2, 3, 6)), "c": c, "b": b}})
    return idata, model


RECORD_3 = np.random.default_rng(4).uniform([-1, -2, -1], [1, 2, 1], (30, 3))


def test_fields_of_two_states_have_them_as_axes():
    c = 0.1 * np.random.default_rng(5).normal(size=(2, 3, 6))
    idata, model = of_two_states(c)
    at = {"w": [-0.5, 0.0, 1.2]}
    found = psf.field(idata, model, terms={"c": PAIR, "b": POLYNOMIALS}, at=at, random_seed=6)
    assert found["c"]["mean"].dims == ("w", "v")
    w, v = found["c"]["w"].values, found["c"]["v"].values
    assert (w.tolist(), v.min(), v.max(), len(v)) == (at["w"], -2, 2, 41)
    values = np.einsum(
        "cdij,iw,jv->cdwv", c.reshape(2, 3, 3, 2), sines(w, (-1, 1), 3), sines(v, (-2, 2), 2)
    )
    np.testing.assert_allclose(found["c"]["mean"], values.mean(axis=(0, 1)), atol=1e-12)
    np.testing.assert_allclose(found["c"]["sd"], values.std(axis=(0, 1)), atol=1e-12)
    of_library = found["b"]
    v = of_library["v"].values
    np.testing.assert_allclose(v[[0, -1]], [RECORD_3[:, 1].min(), RECORD_3[:, 1].max()], atol=1e-5)
    at_one = psf.field(idata, model, terms={"c": PAIR}, at={"w": -0.5}, n_draws=1)["c"]
    np.testing.assert_allclose(at_one["mean"], found["c"]["mean"].sel(w=[-0.5]))
    exact = np.outer(at["w"], v) - 2 * v**2
    np.testing.assert_allclose(of_library["mean"], exact, atol=1e-12)
    assert of_library["prior_sd"].isnull().all()
    reach = np.ptp(RECORD_3[:, [2, 1]], axis=0) / 10
    apart = abs(RECORD_3[:, [2, 1]] - [0.0, v[7]]) <= reach
    assert of_library["near"][1, 7] == pytest.approx(apart.all(axis=1).mean())


def test_what_the_result_does_not_mean_is_said(model):
    exact = draws_of(*regression(RECORD))
    sd = BASIS.prior_sd(LENGTH, AMPLITUDE).eval()
    with pytest.warns(
        ModelWarning, match=r"c: where the states were, the field has \d+% of its pr"
    ):
        psf.field(draws_of(0 * sd, np.diag(sd**2)), model, terms={"c": BASIS}, n_draws=1)
    small = psf.mechanics.gaussian_process_terms("z", (-0.8, 0.8), 6)
    expected = (
        r"c: in 100% of the draws states leave the boundary of the terms, \[\[-1\.2, 1\.2\]\]"
    )
    with pytest.warns(ModelWarning, match=expected):
        psf.field(exact, model, terms={"c": small}, n_draws=1)
    outside = abs(RECORD) > 1.2
    assert 0.05 < outside.mean() < 1
    within = psf.mechanics.gaussian_process_terms("z", (-1.2, 1.2), 6)
    expected = rf"c: {outside.mean():.0%} of the visited states .* of the box, \[\[-1\.2, 1\.2\]\]"
    with pytest.warns(ModelWarning, match=expected):
        psf.field(exact, model, terms={"c": within}, n_draws=1)
    huge = psf.mechanics.gaussian_process_terms("z", (-0.01, 0.01), 6)
    with pytest.warns(ModelWarning, match="reversed: take a wider box, with as many more sines"):
        psf.field(exact, model, terms={"c": huge}, n_draws=1)
    other = psf.mechanics.gaussian_process_terms("x", (-2, 2), 6)
    with pytest.warns(ModelWarning, match=r"no system has states of the names \['x'\]"):
        found = psf.field(exact, model, terms={"c": other}, n_draws=1)
    assert found["c"]["near"].isnull().all()
    assert found["c"]["visited"].shape == (0, 1)


@pytest.mark.parametrize(("low", "high"), [(-0.8, 0.8), (-1.2, 1.2), (-3.0, 0.5)])
def test_the_box_that_is_advised_holds_the_states(model, low, high):
    """With sines as short as those of the smaller box."""
    small = psf.mechanics.gaussian_process_terms("z", (low, high), 6)
    with pytest.warns(ModelWarning) as warned:
        psf.field(draws_of(*regression(RECORD)), model, terms={"c": small}, n_draws=1)
    said = re.search(r"take the box (.*), with n=(.*) sines$", str(warned[0].message))
    box, n = map(json.loads, said.groups())
    wide = psf.mechanics.gaussian_process_terms("z", box, n)
    assert low >= box[0][0] > RECORD.min() - 0.2 or box[0][0] == low
    assert high <= box[0][1] < RECORD.max() + 0.2
    assert 0.85 * small.shortest_length < wide.shortest_length <= small.shortest_length
    draws = draws_of(np.zeros(len(wide)), np.diag(0.01 * wide.prior_sd(LENGTH, 1.0).eval() ** 2))
    found = psf.field(draws, of_one_state(wide), terms={"c": wide}, n_draws=1)
    assert found["c"].attrs["doubts"] == ""


@pytest.mark.parametrize("shape", [None, "of_each_state"])
@pytest.mark.parametrize(("length", "said"), [(0.5, True), (0.8, False)])
def test_lengths_that_the_terms_cannot_follow_are_said(length, said, shape):
    """A fifth of the draws has this length; the shortest of six sines is 0.75."""
    idata = draws_of(*regression(RECORD))
    idata["posterior"]["length"] = xr.full_like(
        idata["posterior"]["c"].isel(c_dim_0=0, drop=True), 2.0
    )
    idata["posterior"]["length"][:, ::5] = length
    if shape:
        idata["posterior"]["length"] = idata["posterior"]["length"].expand_dims(state=["z"], axis=2)
    expected = (
        r"c: in 20% of the draws the length of the kernel is below \[0\.749\], the shortest that "
        r"\[6\] sines can follow, so .*: take n=\[9\], or a prior"
    )
    with pytest.warns(ModelWarning, match=expected) if said else nullcontext():
        psf.field(idata, of_one_state(length=shape), terms={"c": BASIS}, n_draws=1)


def test_a_prior_is_advised_where_sines_would_be_too_many():
    """The shortest lengths of a prior that begins at zero ask for hundreds of them."""
    idata = draws_of(*regression(RECORD))
    lengths = np.linspace(1e-3, 2.0, N_DRAWS).reshape(4, -1)
    idata["posterior"]["length"] = xr.DataArray(lengths**3, dims=("chain", "draw"))
    with pytest.warns(ModelWarning, match="say: take a prior of the length that begins there"):
        psf.field(idata, of_one_state(length=None), terms={"c": BASIS}, n_draws=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"terms": BASIS}, "terms must give the terms of each vector of coefficients"),
        ({"terms": {"c": np.sin}}, "terms must be of gaussian_process_terms or polynomial_terms"),
        ({"terms": {"b": BASIS}}, r"idata must have draws of 'b', got a posterior with \['c'\]"),
        ({"terms": {"c": PAIR}, "at": {"z": [0]}}, r"at must give values of the states \['v', 'w'"),
        ({"at": [0.0, 1.0]}, r"at must give values of the states \['z'\], as \{'z': np.lin"),
        ({"at": {"z": [1.0, 0.0]}}, r"at\['z'\] must have values that rise"),
        ({"at": {"z": [0.0, 3.5]}}, r"at\['z'\] must lie within the boundary .*, -3 to 3, beyond"),
        ({"ci_prob": 90}, "ci_prob must be a number between 0 and 1, got 90"),
        ({"n_draws": 0}, "n_draws must be an integer of at least 1, got 0"),
        (
            {"terms": {"c": psf.mechanics.polynomial_terms("z", 2)}},
            r"'c' in idata must have the 3 coefficients of its terms, got shape \(6,\)",
        ),
        (
            {"terms": {"c": psf.mechanics.polynomial_terms("z", 4, also={"g": lambda z, g: z})}},
            r"terms must have no parameters of their own, got \['g'\] in those of 'c'",
        ),
        (
            {"terms": {"c": psf.mechanics.polynomial_terms("mean", 5)}},
            r"states of terms must not have names of the result, got \['mean'\]",
        ),
    ],
)  # fmt: skip
def test_bad_input(model, settings, message):
    with pytest.raises(ModelError, match=message):
        psf.field(draws_of(*regression(RECORD)), model, **{"terms": {"c": BASIS}} | settings)
