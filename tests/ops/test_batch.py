"""Many parameter points side by side: the numbers of each alone, whatever its neighbours do.

Large states, whose points are evaluated in turn, are in `tests/compiler/test_large_states.py`.
"""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.graph.replace import vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.tensor.blockwise import Blockwise

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.arguments import LANES
from pymc_statespace_filters.ops import signatures
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient
from tests.systems import PAIR, PAIR_DATA, STEPS

RECORD = (STEPS, PAIR_DATA, np.zeros((0, 0)), np.array(0.0), np.array(7))
rng = np.random.default_rng(1)
POINTS = np.column_stack([rng.uniform(-0.9, 0.9, 2 * LANES + 3), rng.normal(size=2 * LANES + 3)])

# Every kind of function: of parameters alone, with time and inputs, branches, a covariance that
# may be impossible, and growth that overflows.
BENT = psf.StateSpaceModel(
    transition=lambda x, q, u, t, a, c: [
        x[0] + 0.1 * (x[1] + u[0] * pt.cos(c * t)),
        pt.exp(a) * x[1] - pt.switch(x[0] > 0.0, pt.sqrt(c), 1.0) * x[0] ** 3 + q[0],
    ],
    process_noise=lambda v: [[v]],
    observation=lambda x, c: [x[0] + c, pt.log1p(x[1] ** 2)],
    observation_noise=lambda c: [[0.5, 0.1], [0.1, c]],
    initial_mean=lambda a: [pt.exp(a), 0.3],
    initial_cov=[[1.0, 0.0], [0.0, 2.0]],
    inputs=["force"],
)
BENT_RECORD = (STEPS, PAIR_DATA, np.linspace(-1.0, 1.0, 7)[:, None], np.array(0.5), np.array(0))


def bent_points(n):
    """Points (a, c, v), most of them harmless."""
    draw = np.random.default_rng(2)
    return np.column_stack(
        [draw.uniform(-2, -0.5, n), draw.uniform(0.3, 2, n), draw.uniform(size=n)]
    )


def batch_and_loop(system, points, record):
    batch = evaluator(LogLikelihood(system, psf.EKF(), signatures.POINTS))(points, *record)
    alone = evaluator(LogLikelihood(system, psf.EKF()))
    loop = [alone(point, *record) for point in points]
    return batch, [np.array([one[i] for one in loop]) for i in (0, 1)]


@pytest.mark.parametrize("n", [1, 7, 8, LANES, LANES + 1, 2 * LANES + 3])
def test_a_batch_is_its_points(n):
    (terms, health), (terms_alone, health_alone) = batch_and_loop(PAIR, POINTS[:n], RECORD)
    np.testing.assert_allclose(terms, terms_alone, rtol=1e-12)
    np.testing.assert_array_equal(health, health_alone)


def test_an_empty_batch():
    terms, health = evaluator(LogLikelihood(PAIR, psf.EKF(), signatures.POINTS))(
        np.zeros((0, 2)), *RECORD
    )
    assert terms.shape == (0, 4)
    assert health.shape == (0, 3)


def test_failing_points_touch_no_neighbour():
    points = bent_points(2 * LANES)
    points[1, 0] = 800.0  # exp overflows at once
    points[4, 0] = 60.0  # the state explodes on the way
    points[5, 1] = -0.2  # a noise that is no covariance
    points[6, 2] = -5.0  # another
    points[LANES + 2] = np.nan
    (terms, health), (terms_alone, health_alone) = batch_and_loop(BENT, points, BENT_RECORD)
    finite = np.isfinite(terms_alone)
    assert not finite[[1, 4, 5, 6, LANES + 2]].all(axis=1).any()
    assert finite[7:LANES].all()
    np.testing.assert_array_equal(np.isfinite(terms), finite)
    np.testing.assert_array_equal(terms[~finite], -np.inf)
    np.testing.assert_array_equal(health, health_alone)
    np.testing.assert_allclose(terms[finite], terms_alone[finite], rtol=1e-12)


def test_points_that_all_fail():
    points = np.full((3, 3), np.nan)
    (terms, health), (terms_alone, health_alone) = batch_and_loop(BENT, points, BENT_RECORD)
    np.testing.assert_array_equal(terms, terms_alone)
    np.testing.assert_array_equal(health, health_alone)


@pytest.mark.usefixtures("interpreted")
def test_vectorizing_a_graph_over_parameters_makes_one_batch():
    theta, thetas = pt.dvector("theta"), pt.dtensor3("thetas")
    terms, health = LogLikelihood(PAIR, psf.EKF())(theta, *RECORD)
    batched = vectorize_graph([terms, health], {theta: thetas})
    function = pytensor.function([thetas], batched)
    kinds = {type(node.op) for node in function.maker.fgraph.apply_nodes}
    assert LogLikelihood in kinds
    assert not any(issubclass(kind, Blockwise) for kind in kinds)
    got = function(POINTS[:6].reshape(2, 3, 2))
    direct = evaluator(LogLikelihood(PAIR, psf.EKF(), signatures.POINTS))(POINTS[:6], *RECORD)
    for a, b in zip(got, direct, strict=True):
        np.testing.assert_array_equal(a, b.reshape(2, 3, -1))
    assert function(np.zeros((0, 3, 2)))[0].shape == (0, 3, 4)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(20)], ids=["EKF", "BootstrapPF"])
def test_other_batches_are_loops(filter):
    """Data that differ from point to point, and filters that draw."""
    theta, thetas, data = pt.dvector("theta"), pt.dmatrix("thetas"), pt.dmatrix("data")
    terms = LogLikelihood(PAIR, filter)(theta, STEPS, data, *RECORD[2:])[0]
    datas = pt.dtensor3("datas")
    batches = {theta: thetas, data: datas} if not filter.noisy else {theta: thetas}
    nodes = [v.owner for v in ancestors([vectorize_graph(terms, batches)]) if v.owner]
    assert [n for n in nodes if isinstance(n.op, Blockwise)]
    assert not [n for n in nodes if getattr(n.op, "form", None) == signatures.POINTS]


@pytest.mark.usefixtures("interpreted")
def test_gradient_of_a_batch():
    thetas = pt.dmatrix("thetas")
    terms, _ = LogLikelihood(PAIR, psf.EKF(), signatures.POINTS)(thetas, *RECORD)
    function = pytensor.function([thetas], pt.grad(terms.sum(), thetas))
    alone = evaluator(LogLikelihoodGradient(PAIR, psf.EKF()))
    want = [alone(point, *RECORD, np.ones(4))[0] for point in POINTS[:3]]
    np.testing.assert_allclose(function(POINTS[:3]), want, rtol=1e-12)


@pytest.mark.usefixtures("interpreted")
def test_log_density_of_a_batch_of_parameters_in_pymc():
    thetas = pt.dmatrix("thetas")
    record = (STEPS, np.zeros((0, 0)), 0.0, 0)
    d = psf.StateSpace.dist(thetas, *record, system=PAIR, filter=psf.EKF())
    logp = pm.logp(d, PAIR_DATA)
    nodes = [v.owner for v in ancestors([logp]) if v.owner]
    assert [n for n in nodes if getattr(n.op, "form", None) == signatures.POINTS]
    got = pytensor.function([thetas], logp)(POINTS[:3])
    direct, _ = evaluator(LogLikelihood(PAIR, psf.EKF(), signatures.POINTS))(POINTS[:3], *RECORD)
    np.testing.assert_allclose(got, direct, rtol=1e-12)
