"""Systems with the doses of clinical tables: closed forms, and likelihoods of others."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.pharmacometrics import normal_error, read_events

DOCS = Path(__file__).parents[2] / "docs"
NAN = np.nan
K, II, DOSE = 0.5, 8.0, 100.0

bolus = psf.StateSpaceModel(
    transition=psf.ExactLinear(lambda k: [[-k]], [[0.0]], dt=1.0),
    event=lambda x, dose: [x[0] + dose],
    events=["dose"],
    initial_mean=[0.0],
    initial_cov=[[0.0]],
    **normal_error(lambda x: [x[0]], additive="sd"),
)
infused = psf.StateSpaceModel(
    transition=psf.LocalLinearization(lambda x, u, k: [u[0] - k * x[0]], dt=1.0),
    inputs=["infusion"],
    initial_mean=[0.0],
    initial_cov=[[0.0]],
    **normal_error(lambda x: [x[0]], additive="sd"),
)


def means(system, rows, columns, **settings):
    """The amounts at the observations of a table, whose DV does not matter."""
    record = read_events(
        pd.DataFrame(rows, columns=columns.split()), observables=["amount"], **settings
    )
    found = psf.run_filter(system, psf.EKF(), {"k": K, "sd": 1.0}, **record)
    return found["mean"].values[:, 0]


def test_boluses_are_those_of_the_closed_form():
    columns, earlier = "ID TIME AMT ADDL II SS DV", 8
    rows = [
        ("order", 0, 0, 0, 0, 0, 1.0),
        ("order", 0, DOSE, 0, 0, 0, NAN),
        ("order", 3, DOSE, 0, 0, 0, NAN),
        ("order", 3, 0, 0, 0, 0, 1.0),
        ("more", 1.3, DOSE, 2, II, 0, NAN),
        ("more", 2.0, 0, 0, 0, 0, 1.0),
        ("more", 1.3 + II, 0, 0, 0, 0, 1.0),  # before the dose that follows from the first row
        ("more", 30.7, 0, 0, 0, 0, 1.0),
        ("settled", 0, DOSE, 1, II, 1, NAN),
        ("settled", 0, 0, 0, 0, 0, 1.0),
        ("settled", 5.1, 0, 0, 0, 0, 1.0),
        ("settled", II, 0, 0, 0, 0, 1.0),
        ("settled", II + 1, 0, 0, 0, 0, 1.0),
        ("settled", 3 * II, 0, 0, 0, 0, 1.0),
    ]

    def left(*times):
        return sum(DOSE * np.exp(-K * t) for t in times)

    peak = DOSE / (1 - np.exp(-K * II))
    expected = [
        0.0,
        left(3, 0),
        left(0.7),
        left(II),
        left(*(30.7 - 1.3 - II * np.arange(3))),
        *(peak * np.exp(-K * t) for t in (0.0, 5.1, II, 1.0, 2 * II)),
    ]
    assert np.exp(-K * II * earlier) < 1e-13
    found = means(bolus, rows, columns, ss_doses=earlier, t0=-earlier * II)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    # The distance from the steady state is that of the documentation.
    near = means(bolus, rows[8:], columns, ss_doses=1)
    assert 1 - near[0] / peak == pytest.approx(np.exp(-2 * K * II))


def test_limits_are_those_of_cens():
    """CENS 1 is a value below DV, -1 one above."""
    columns = "ID TIME AMT CENS DV"
    rows = [(1, 0, DOSE, 0, NAN), (1, 1, 0, 1, 62.0), (1, 2, 0, -1, 35.0), (1, 3, 0, 0, 22.0)]
    table = pd.DataFrame(rows, columns=columns.split())
    record = read_events(table, observables=["amount"])
    found = psf.log_likelihood(bolus, psf.EKF(), {"k": K, "sd": 2.0}, **record)
    at = [DOSE * np.exp(-K * t) for t in (1, 2, 3)]
    expected = [
        norm.logcdf(62.0, at[0], 2.0),
        norm.logsf(35.0, at[1], 2.0),
        norm.logpdf(22.0, at[2], 2.0),
    ]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_infusions_are_those_of_the_closed_form():
    """Two overlap, and one begins at an observation."""
    infusions = [(0.3, 6.0, 3.0), (1.1, 5.0, 2.0), (4.0, 8.0, 16.0)]
    times = [0.2, 1.0, 2.0, 4.0, 9.0]
    rows = [("A", t, amount, rate, NAN) for t, amount, rate in infusions]
    rows += [("A", t, 0.0, 0.0, 1.0) for t in times]
    rows = sorted(rows, key=lambda row: row[1])
    rows += [("B", 0.0, 12.0, 4.0, NAN), ("B", 5.0, 0.0, 0.0, 1.0)]

    def amount(t, start, total, rate):
        runs = np.clip(t - start, 0.0, total / rate)
        return rate / K * (1 - np.exp(-K * runs)) * np.exp(-K * np.maximum(t - start - runs, 0.0))

    expected = [sum(amount(t, *one) for one in infusions) for t in times] + [amount(5, 0, 12, 4)]
    found = means(infused, rows, "ID TIME AMT RATE DV", t0=0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_theophylline_is_that_of_the_closed_form():
    """Twelve people, with a dose into the gut above the first sample."""
    data = pd.read_csv(DOCS / "tutorials" / "theophylline.csv")
    samples = pd.DataFrame(
        {"ID": data["subject"], "TIME": data["time"], "DV": data["concentration"]}
    )
    doses = samples.drop_duplicates("ID").assign(AMT=data["dose"], DV=NAN, CMT="gut")
    table = pd.concat([doses, samples]).sort_values(["ID", "TIME"], kind="stable")
    record = read_events(table, observables=["conc"], compartments=["gut", "blood"])
    system = psf.StateSpaceModel(
        transition=psf.ExactLinear(lambda ka, ke: [[-ka, 0.0], [ka, -ke]], np.zeros((2, 1)), dt=30),
        event=lambda x, dose_gut: [x[0] + dose_gut, x[1]],
        events=["dose_gut"],
        initial_mean=[0.0, 0.0],
        initial_cov=np.zeros((2, 2)),
        **normal_error(lambda x, ke, cl: [x[1] * ke / cl], additive="sigma"),
    )
    at = {"ka": 1.6, "ke": 0.086, "cl": 0.04, "sigma": 0.7}
    found = psf.log_likelihood(system, psf.EKF(), at, **record)
    ka, ke, cl, sigma = at.values()
    t = data["time"]
    curve = data["dose"] * ka * ke / cl / (ka - ke) * (np.exp(-ke * t) - np.exp(-ka * t))
    np.testing.assert_allclose(found, norm.logpdf(data["concentration"], curve, sigma), atol=1e-9)


@pytest.fixture(scope="module")
def two_compartments():
    """Simulated data of the R package PSM (vignettes/simdose.RData), one noise in two states."""

    def rates(CL, V, CLd=0.1, V2=10.0):
        return [[-(CL + CLd) / V, CLd / V2], [CLd / V, -CLd / V2]]

    system = psf.StateSpaceModel(
        transition=psf.ExactLinear(rates, lambda sig1: [[sig1], [-sig1]], dt=10.0),
        event=lambda x, dose_central: [x[0] + dose_central, x[1]],
        events=["dose_central"],
        initial_mean=[0.0, 0.0],
        initial_cov=np.zeros((2, 2)),
        **normal_error(lambda x, V: [x[0] / V], additive="sd"),
    )
    return system, pd.read_csv(DOCS / "howto" / "two_compartments.csv", na_values=".")


def negative_log_likelihood(system, record, CL, V1, sig1, S, OMEGA):
    """Of a population whose volumes are V1 exp(eta), by quadrature over eta of each person."""
    at = {"CL": CL, "sig1": sig1, "sd": np.sqrt(S)}
    starts = np.flatnonzero(np.diff(record["panel"].astype(int), prepend=0))

    def joint(eta):
        volumes = {"V": V1 * np.exp(eta)}
        terms = psf.log_likelihood(system, psf.EKF(), at | volumes, **record)
        return np.add.reduceat(terms, starts) + norm.logpdf(eta, 0.0, np.sqrt(OMEGA))

    grid = np.linspace(-1.5, 1.5, 60)
    values = np.array([joint(np.full(len(starts), eta)) for eta in grid])
    weights = np.exp(values - logsumexp(values, axis=0))
    mean = grid @ weights
    sd = np.sqrt(grid**2 @ weights - mean**2)
    nodes, of_nodes = np.polynomial.hermite_e.hermegauss(12)
    terms = [joint(mean + sd * z) + z**2 / 2 for z in nodes] + np.log(np.outer(of_nodes, sd))
    return -logsumexp(terms, axis=0).sum()


@pytest.mark.parametrize(
    ("t0", "point", "expected"),
    [
        # At the estimates of PSM, and at the maximum; then with the start of PSM, whose
        # covariance is the noise of one interval of ten minutes.
        (None, (0.0497952, 3.7223410, 10.2369665, 17.6984401, 0.2057562), 726.7368),
        (None, (0.049769, 3.71768, 10.2583, 19.8226, 0.21996), 726.6034),
        (0.0, (0.0497952, 3.7223410, 10.2369665, 17.6984401, 0.2057562), 725.918),
    ],
)
def test_a_population_has_the_known_likelihood(two_compartments, t0, point, expected):
    system, table = two_compartments
    record = read_events(table, observables=["conc"], compartments=["central"], t0=t0)
    assert negative_log_likelihood(system, record, *point) == pytest.approx(expected, abs=1e-3)
