"""Rival models row by row, as drawn and as numbers."""

import numpy as np
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError, ModelError
from tests.plots.drawn import drawn

ROWS = np.array([2.0, 5.0, 6.0])


def course(paths, rows=ROWS, fingerprint="0c5f"):
    """A sequential run by the log-evidences of its populations after each row."""
    paths = np.asarray(paths)
    scores = np.diff(paths.mean(axis=0), prepend=0.0)
    found = xr.Dataset(
        {
            "log_evidence_so_far": (("population", "row"), paths),
            "score": ("row", scores),
            "score_se": ("row", np.full(len(rows), 0.1)),
        },
        coords={"row": rows},
    )
    evidence = xr.Dataset(
        {"data_fingerprint": ("estimator", [fingerprint])}, coords={"estimator": ["smc"]}
    )
    return xr.DataTree.from_dict({"smc": found, "evidence": evidence})


RIVALS = {
    "one": course([[-1.0, -2.0, -4.0]] * 2),
    "two": course([[-2.0, -2.0, -3.0]] * 2),
}
NOISY = RIVALS | {"two": course(np.add.outer([0.2, -0.2], [-2.0, -2.0, -3.0]))}


def test_numbers():
    table = psf.compare_evidence(RIVALS, by="row")
    np.testing.assert_allclose(table["score_difference"].sel(model="two"), [-1.0, 1.0, 1.0])
    np.testing.assert_allclose(table["log_bayes_factor"].sel(model="two"), [-1.0, 0.0, 1.0])
    np.testing.assert_allclose(table["score_difference_se"].sel(model="two"), np.hypot(0.1, 0.1))
    assert (table["score_difference_se"].sel(model="one") == 0).all()
    odds = 1 / (1 + np.exp([1.0, 0.0, -1.0]))
    np.testing.assert_allclose(table["probability"].sel(model="two"), odds)
    np.testing.assert_allclose(table["probability_low"].sel(model="two"), odds)
    np.testing.assert_array_equal(table["row"], ROWS)


def test_prior_weights_and_the_probability_of_intervals():
    even = psf.compare_evidence(NOISY, by="row").sel(model="two")
    weighted = psf.compare_evidence(
        NOISY, by="row", model_prior={"one": 1.0, "two": 3.0}, ci_prob=0.5
    ).sel(model="two")
    odds = 3.0 * even["probability"] / (1.0 - even["probability"])
    np.testing.assert_allclose(weighted["probability"], odds / (1.0 + odds))
    narrow, wide = (one["probability_high"] / one["probability"] for one in (weighted, even))
    assert (narrow < wide).all()
    with pytest.raises(ModelError, match="estimator and step_errors must be None by row"):
        psf.compare_evidence(NOISY, by="row", estimator="bridge")
    with pytest.raises(ModelError, match="by must be 'model' or 'row', got 'column'"):
        psf.compare_evidence(NOISY, by="column")


def test_errors_widen_bands():
    table = psf.compare_evidence(NOISY, by="row").sel(model="two")
    assert (table["log_bayes_factor_se"] > 0.2).all()
    assert (table["probability_low"] < table["probability"]).all()
    assert (table["probability_high"] > table["probability"]).all()


@pytest.mark.parametrize("backend", ["none", "matplotlib", "plotly", "bokeh"])
def test_every_backend_draws(backend):
    collection = psf.plot_prequential(NOISY, backend=backend)
    if backend == "none":
        factor = drawn(collection, "curve", "log_bayes_factor")["two"]
        np.testing.assert_array_equal(factor["x"], ROWS)
        np.testing.assert_allclose(factor["y"], [-1.0, 0.0, 1.0], atol=0.05)
        score = np.asarray(drawn(collection, "bar", "score_difference")["two"]["y"])
        np.testing.assert_allclose(score[1::3], [-1.0, 1.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("results", "error", "match"),
    [
        ({"one": RIVALS["one"]}, ModelError, "at least two models .* got dict of 1"),
        (RIVALS["one"], ModelError, "got DataTree"),
        (RIVALS | {"two": 3}, ModelError, "got for 'two' int"),
        (
            RIVALS | {"two": xr.DataTree.from_dict({"smc": xr.Dataset()})},
            ModelError,
            "got for 'two' a tempered run",
        ),
        (
            RIVALS | {"two": course([[-1.0, -2.0]] * 2, ROWS[:2])},
            DataMismatchError,
            "3 of 'one' and 2 of 'two'",
        ),
        (
            RIVALS | {"two": course([[-1.0, -2.0, -3.0]] * 2, fingerprint="ffff")},
            DataMismatchError,
            "got others of 'two'",
        ),
    ],
)
def test_bad_input(results, error, match):
    with pytest.raises(error, match=match):
        psf.plot_prequential(results, backend="none")
