"""The density with scalars held equals that of a model made without them."""

import numpy as np
import pymc as pm

from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.switched_density import SwitchedDensity, Switches


def full_model():
    with pm.Model() as model:
        scale = pm.HalfNormal("scale", 1)
        b = pm.Normal("b", 0, scale, shape=3)
        c = pm.HalfNormal("c", 2)
        low = pm.Uniform("low", 0, 1 + c)  # the support depends on a scalar that may be held
        weights = pm.Dirichlet("weights", np.ones(3))
        pm.Potential("near", -0.1 * (low - c) ** 2)
        pm.Deterministic("total", b.sum() + c)
        pm.Normal("y", b.sum() + c + low + weights[0], 0.5, observed=[0.3, 1.2])
    return model


def test_held_scalars_leave_the_density_of_the_others():
    model = full_model()
    density = SwitchedDensity(
        model, Switches((np.array([2]), np.array([4])), (np.array([0.0]), np.array([0.0])))
    )
    x = np.random.default_rng(1).standard_normal((2, 8))
    x[1] = x[0]
    x[1, [2, 4]] += 5.0  # columns of what is held
    seeds = np.empty((2, 0), dtype=np.int64)
    on, off = np.ones((2, 2), dtype=bool), np.zeros((2, 2), dtype=bool)
    np.testing.assert_allclose(
        density.evaluate_in_parts(x, on, seeds).total, ModelDensity(model).evaluate(x), rtol=1e-12
    )
    found = density.evaluate_in_parts(x, off, seeds)
    np.testing.assert_array_equal(found.total, found.total[0])
    # Without the priors of the scalars that are held.
    with pm.Model() as rest:
        scale = pm.HalfNormal("scale", 1)
        b = pm.Normal("b", 0, scale, shape=2)
        low = pm.Uniform("low", 0, 1)
        weights = pm.Dirichlet("weights", np.ones(3))
        pm.Potential("near", -0.1 * low**2)
        pm.Normal("y", b.sum() + low + weights[0], 0.5, observed=[0.3, 1.2])
    others = x[:1, [0, 1, 3, 5, 6, 7]]
    np.testing.assert_allclose(found.total[:1], ModelDensity(rest).evaluate(others), rtol=1e-12)
    own = np.zeros(found.held.shape[1])
    scale_there = np.exp(x[0, 0])
    own[2] = -np.log(scale_there) - 0.5 * np.log(2 * np.pi)
    own[4] = 0.5 * np.log(2 / np.pi) - np.log(2)
    np.testing.assert_allclose(found.held[0], own, rtol=1e-8)  # PyMC has log 2 as float32
    assert density.blocks.tolist() == [0, 1, 2, 3, 4, 5, 6, 6]
    values = density.constrained([model["b"], model["c"], model["total"]])(x, off)
    assert (values["c"] == 0).all()
    assert (values["b"][:, 1] == 0).all()
    np.testing.assert_allclose(values["total"], values["b"].sum(axis=1), rtol=1e-12)
