"""How many observations, and which: the same for rival models of one record."""

import hashlib
import struct

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence import observed_data

RECORD = np.array([[0.1, 2.0], [np.nan, 1.0], [np.nan, np.nan], [0.4, -0.0]])


def vector_model(values, name="d"):
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1, shape=2)
        # As a tensor: an array with missing values would be imputed.
        pm.MvNormal(name, mu, np.eye(2), observed=pt.as_tensor(values))
    return model


def scalar_model(values, sd=1.0):
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        pm.Normal("y", mu, sd, observed=pt.as_tensor(values))
    return model


def observation_count(model):
    return observed_data.observation_count(observed_data.observed_in(model))


def data_fingerprint(model):
    return observed_data.data_fingerprint(observed_data.observed_in(model))


def test_rows_count_unless_wholly_missing():
    assert observation_count(vector_model(RECORD)) == 3


def test_scalars_count_unless_missing():
    assert observation_count(scalar_model(RECORD)) == 5


def test_several_variables_add_up():
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        pm.Normal("a", mu, 1, observed=[1.0, 2.0])
        pm.Poisson("b", pm.math.exp(mu), observed=[3, 4, 5])
    assert observation_count(model) == 5


def test_a_model_without_data():
    with pm.Model() as model:
        pm.Normal("mu", 0, 1)
    assert observation_count(model) == 0


def test_rivals_on_one_record_share_a_fingerprint():
    column = RECORD[:, :1]
    assert data_fingerprint(scalar_model(RECORD)) == data_fingerprint(vector_model(RECORD, "other"))
    assert data_fingerprint(scalar_model(column)) == data_fingerprint(
        scalar_model(column[:, 0], sd=2)
    )
    assert data_fingerprint(scalar_model(RECORD)) == data_fingerprint(scalar_model(RECORD + 0.0))


def test_shared_data_are_read_as_they_are_now():
    with pm.Model() as model:
        y = pm.Data("data", [1.0, 2.0])
        pm.Normal("y", 0, 1, observed=y)
    before = data_fingerprint(model)
    pm.set_data({"data": [1.0, 3.0]}, model=model)
    assert data_fingerprint(model) != before


@pytest.mark.parametrize(
    "other",
    [RECORD + 1e-12, RECORD[:3], RECORD.T, np.nan_to_num(RECORD), RECORD[::-1]],
    ids=["value", "length", "shape", "missing", "order"],
)
def test_other_data_have_another_fingerprint(other):
    assert data_fingerprint(scalar_model(other)) != data_fingerprint(scalar_model(RECORD))


def test_order_of_the_variables_does_not_matter():
    def model(*records):
        with pm.Model() as model:
            for i, record in enumerate(records):
                pm.Normal(f"y{i}", 0, 1, observed=record)
        return model

    a, b = np.array([1.0, 2.0]), np.array([3.0])
    assert data_fingerprint(model(a, b)) == data_fingerprint(model(b, a))
    assert data_fingerprint(model(a, b)) != data_fingerprint(model(np.append(a, b)))


def test_fingerprint_is_stable_across_processes():
    """Nothing of this process is in it: one variable, of shape (2,), without a missing value."""
    content = b"(2,)" + struct.pack("<2d", 1.0, 2.0)
    expected = hashlib.sha256(hashlib.sha256(content).digest()).hexdigest()
    assert data_fingerprint(scalar_model(np.array([1.0, 2.0]))) == expected


def panel_model(order, lengths=(2, 3)):
    """Records of these lengths, in this order, as one panel."""
    labels = np.concatenate([np.full(lengths[g], g) for g in order])
    steps = np.concatenate([np.arange(lengths[g]) for g in order])
    with pm.Model() as model:
        psf.StateSpace(
            "d",
            LEVEL,
            psf.EKF(),
            panel=labels,
            steps=steps,
            observed=np.concatenate([RECORDS[g][: lengths[g]] for g in order]),
        )
    return model


RECORDS = [np.array([0.1, 0.3]), np.array([0.2, np.nan, 0.5])]
LEVEL = psf.StateSpaceModel(
    transition=lambda x, q: [x[0] + q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[1.0]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def test_records_of_a_panel_count_like_variables():
    with pm.Model() as variables:
        for name, record in zip("ba", RECORDS, strict=True):
            steps = np.arange(record.size)
            psf.StateSpace(name, LEVEL, psf.EKF(), steps=steps, observed=record)
    expected = data_fingerprint(variables)
    assert data_fingerprint(panel_model([0, 1])) == expected
    assert data_fingerprint(panel_model([1, 0])) == expected
    assert data_fingerprint(panel_model([0, 1], lengths=(2, 2))) != expected
    assert data_fingerprint(panel_model([0], lengths=(2, 3))) != expected
