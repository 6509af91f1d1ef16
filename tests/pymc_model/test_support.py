"""What an evidence owes to the supports of its priors, and how it says so."""

import numpy as np
import pymc as pm
import pytest
from pymc.distributions.transforms import log, ordered

from pymc_statespace_filters.pymc_model.prior import Support

DATA = np.array([0.3, 1.2, 0.8])


def test_volumes_of_scalars_vectors_and_dependent_bounds():
    with pm.Model() as model:
        pm.Uniform("a", 0, 200)
        pm.Uniform("b", [-1.0, -2.0], 0.0)
        pm.Uniform("c", 0, pm.Data("width", 5.0), shape=3, default_transform=None)
        upper = pm.HalfNormal("upper", 1)
        pm.Uniform("d", 0, upper)  # no constant volume
        pm.Beta("e", 1, 1)  # uniform by accident
        pm.Uniform("y", 0, 10, observed=DATA)
    support = Support.of(model)
    assert support.log_volume == pytest.approx(np.log(200 * 1 * 2 * 5**3), rel=1e-14)
    assert support.uniform == "a, b, c"
    assert support.improper == ""
    assert not list(support.check())


def test_densities_without_an_integral_or_with_another_one():
    with pm.Model() as model:
        pm.Flat("flat", shape=2)
        half = pm.HalfFlat("half")
        pm.GaussianRandomWalk("walk", init_dist=pm.Flat.dist(), shape=3)
        pm.ICAR("field", W=np.array([[0, 1], [1, 0]]))
        pm.Normal("sorted", 0, 1, shape=3, transform=ordered, initval=[0, 1, 2])
        pm.Normal("positive", 0, 1, transform=log)
        pm.Normal("proper_given", 0, half)  # its own density is proper, whatever its scale's is
        pm.Uniform("interval", 0, half)
        pm.HalfNormal("log")
        pm.Dirichlet("simplex", np.ones(3))
        pm.VonMises("angle", 0, 1)
        pm.ZeroSumNormal("zero_sum", 1, shape=3)
        pm.Truncated("truncated", pm.Normal.dist(0, 1), lower=0, upper=1)
        pm.LKJCholeskyCov("chol", n=2, eta=1, sd_dist=pm.HalfNormal.dist(1), compute_corr=False)
    support = Support.of(model)
    assert support.improper == "flat, half, walk, field, sorted, positive"
    of_transforms, of_others = support.check()
    assert "the prior of sorted, positive, which is not normalised" in of_transforms
    assert "the prior of flat, half, walk, field is improper" in of_others
    assert "depends on the units of the parameters: give them proper priors" in of_others
