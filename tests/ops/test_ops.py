"""The likelihood as an operation: pure, comparable, picklable, with an exact derivative."""

import pickle

import cloudpickle
import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.mode import Mode
from pytensor.graph.traversal import ancestors

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.errors import GradientUnavailableError, ModelError
from pymc_statespace_filters.filters.checks import check_choice
from pymc_statespace_filters.ops.base import evaluator, kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient
from tests.systems import FORCED, PAIR, PAIR_DATA, STEPS, forced, pair, pair_terms

PF = psf.BootstrapPF(20)
NOISY = [psf.EnKF(20), PF, psf.PFEnKF(20)]
THETA = np.array([0.6, 0.2])


def inputs(theta=THETA, observed=PAIR_DATA, steps=STEPS, seed=7):
    """Values of every input of an Op on PAIR."""
    zero_inputs = np.zeros((0, 0))
    return theta, np.asarray(steps), observed, zero_inputs, np.array(0.0), np.array(seed)


def terms_of(filter, theta, seed=7):
    """Symbolic terms, everything but theta constant."""
    return LogLikelihood(PAIR, filter)(theta, *inputs(seed=seed)[1:])[0]


# Identity.


@pytest.mark.parametrize("kind", [LogLikelihood, LogLikelihoodGradient])
def test_ops_of_equal_equations_and_settings_are_equal(kind):
    op, same = kind(PAIR, psf.EKF()), kind(pair(), psf.EKF())
    assert op == same
    assert hash(op) == hash(same)
    assert op != kind(PAIR, PF)
    assert op != kind(pair(initial_mean=[0.0, 0.4]), psf.EKF())
    assert LogLikelihood(PAIR, psf.EKF()) != LogLikelihoodGradient(PAIR, psf.EKF())


def test_equal_evaluations_are_made_once():
    theta = pt.dvector("theta")
    same = [LogLikelihood(s, psf.EKF())(theta, *inputs()[1:])[0] for s in (PAIR, pair())]
    other = terms_of(psf.EKF(), theta, seed=8)
    function = pytensor.function([theta], [*same, other], mode=Mode(linker="py"))
    evaluations = [n for n in function.maker.fgraph.apply_nodes if isinstance(n.op, LogLikelihood)]
    assert len(evaluations) == 2
    np.testing.assert_array_equal(function(THETA)[0], function(THETA)[1])


def test_graphs_of_the_package_keep_no_lines_of_source():
    """They take a quarter of the time of a first call. The user's flag is set back."""
    limits = []

    class WatchedOp(LogLikelihood):
        def plan(self, system):
            limits.append(pytensor.config.traceback__limit)
            return super().plan(system)

    class WatchedFilter(psf.EKF):
        def check(self, system):
            limits.append(pytensor.config.traceback__limit)

    with pytensor.config.change_flags(traceback__limit=8):
        check_choice(PAIR, WatchedFilter())
        kernel(WatchedOp(PAIR, psf.EKF()))
        assert pytensor.config.traceback__limit == 8
    assert limits == [0, 0]


def key_of(op):
    """The key of the machine code of an operation, made anew."""
    return kernel.__wrapped__(op).key


@pytest.mark.parametrize("dumps", [pickle.dumps, cloudpickle.dumps])
def test_pickling(dumps):
    op = LogLikelihood(PAIR, PF)
    restored = pickle.loads(dumps(op))
    assert restored == op
    assert hash(restored) == hash(op)
    assert key_of(restored) == key_of(op)


def test_printing_shows_the_filter_and_no_equations():
    printed = pytensor.dprint(terms_of(PF, pt.dvector("theta")), file="str")
    assert "LogLikelihood{BootstrapPF(n_particles=20" in printed
    assert len(printed.splitlines()) < 12


CHANGES = [
    {"process_noise": [[1.0, 0.0], [0.0, 0.6]]},
    {"observation_noise": [[0.5, 0.2], [0.2, 0.4]]},
    {"initial_mean": [0.0, 0.4]},
    {"initial_cov": [[1.0, 0.0], [0.0, 2.1]]},
    {"observation": lambda x: [x[0], 1.1 * x[1]]},
    {"transition": lambda x, q, a, b=0.2: [a * x[0] + b * x[1] + q[0], 0.9 * x[1] + q[1]]},
    {"transition": lambda x, q, t, a, b=0.2: [a * x[0] + b * x[1] + q[0], t * x[1] + q[1]]},
    {"carried": ["x1"]},
]


@pytest.mark.parametrize("filter", [psf.EKF(), *NOISY], ids=lambda f: type(f).__name__)
def test_machine_code_on_disk_is_named_by_all_that_is_compiled_in(filter, monkeypatch):
    monkeypatch.setattr(
        EntryPoint, "compile", lambda entry: None
    )  # names are asked for, not the code
    timed = {"transition": CHANGES[-2]["transition"]}  # dt matters where time is asked for
    systems = [PAIR, *(pair(**c) for c in CHANGES if filter.noisy or "carried" not in c)]
    systems += [pair(**timed, dt=0.5), FORCED]
    keys = [key_of(LogLikelihood(s, filter)) for s in systems]
    assert None not in keys
    assert len(set(keys)) == len(systems)
    assert key_of(LogLikelihood(pair(), filter)) == keys[0]


def test_filters_and_their_settings_have_machine_code_of_their_own():
    filters = [
        psf.EKF(),
        *(psf.EnKF(n, likelihood=word) for n in (20, 21) for word in ("ensemble", "gaussian")),
        *(psf.BootstrapPF(20, resample_below=r) for r in (0.0, 1 / 3, 1.0)),
        psf.BootstrapPF(20, resampling="multinomial"),
        *(psf.PFEnKF(20, likelihood=w) for w in ("predictive", "weights")),
    ]
    keys = [key_of(LogLikelihood(PAIR, filter)) for filter in filters]
    keys.append(key_of(LogLikelihoodGradient(PAIR, psf.EKF())))
    assert None not in keys
    assert len(set(keys)) == len(filters) + 1


# Values.


@pytest.mark.parametrize(
    "mode",
    ["FAST_COMPILE", Mode(linker="vm"), Mode(linker="py")],
    ids=["FAST_COMPILE", "vm", "py"],
)
@pytest.mark.parametrize("filter", [psf.EKF(), PF], ids=lambda f: type(f).__name__)
def test_other_modes_give_the_same_bits(filter, mode):
    theta = pt.dvector("theta")
    outputs = LogLikelihood(PAIR, filter)(theta, *inputs()[1:])
    numba = pytensor.function([theta], outputs)(THETA)
    other = pytensor.function([theta], outputs, mode=mode)(THETA)
    for a, b in zip(numba, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_evaluation_is_pure():
    """Equal inputs, equal outputs, whatever came between; inputs are only read."""
    evaluate = evaluator(LogLikelihood(PAIR, PF))
    given = inputs(observed=PAIR_DATA.copy())
    first, health = evaluate(*given)
    for value, untouched in zip(given, inputs(), strict=True):
        np.testing.assert_array_equal(value, untouched)
    evaluate(*inputs(theta=np.array([1e6, 0.0])))
    other_seed, _ = evaluate(*inputs(seed=8))
    again, health_again = evaluate(*given)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(health, health_again)
    assert np.abs(first - other_seed)[[0, 1, 3]].min() > 1e-6


def test_memory_layout_of_data_does_not_matter():
    evaluate = evaluator(LogLikelihood(PAIR, psf.EKF()))
    theta = np.array([0.6, -1.0, 0.2])[::2]
    layout = inputs(theta, np.asfortranarray(PAIR_DATA), np.repeat(STEPS, 2)[::2])
    np.testing.assert_array_equal(evaluate(*layout)[0], evaluate(*inputs())[0])


def test_shapes_are_known_without_evaluating():
    theta = pt.dvector("theta")
    terms, health = LogLikelihood(PAIR, PF)(theta, *inputs()[1:])
    gradient = LogLikelihoodGradient(PAIR, psf.EKF())(theta, *inputs()[1:], np.ones(4))
    function = pytensor.function([theta], [terms.shape[0], health.shape[0], gradient.shape[0]])
    ops = [type(n.op) for n in function.maker.fgraph.apply_nodes]
    assert LogLikelihood not in ops
    assert LogLikelihoodGradient not in ops
    assert [int(n) for n in function(THETA)] == [4, 3, 2]


# Gradients.


def test_gradient_agrees_with_central_differences_of_the_exact_likelihood():
    theta = pt.dvector("theta")
    slope = pt.grad(terms_of(psf.EKF(), theta).sum(), theta)
    gradient = pytensor.function([theta], slope, mode=Mode(linker="py"))
    h = 1e-5
    for i, step in enumerate(np.eye(2) * h):
        up, down = pair_terms(*(THETA + step)).sum(), pair_terms(*(THETA - step)).sum()
        np.testing.assert_allclose(gradient(THETA)[i], (up - down) / (2 * h), rtol=1e-6)


def test_gradient_of_the_health_alone_is_zero():
    theta = pt.dvector("theta")
    health = LogLikelihood(PAIR, psf.EKF())(theta, *inputs()[1:])[1]
    gradient = pt.grad(health[1], theta, disconnected_inputs="ignore")
    operations = {type(v.owner.op) for v in ancestors([gradient]) if v.owner is not None}
    assert LogLikelihoodGradient not in operations
    np.testing.assert_array_equal(gradient.eval({theta: THETA}, on_unused_input="ignore"), [0, 0])


@pytest.mark.parametrize("filter", NOISY, ids=lambda f: type(f).__name__)
def test_estimates_refuse_to_be_differentiated(filter):
    """PyMC takes NotImplementedError for "use another sampler"; this is nothing of the kind."""
    theta = pt.dvector("theta")
    with pytest.raises(GradientUnavailableError, match=r"psf\.DRAM\(\)") as raised:
        pt.grad(terms_of(filter, theta).sum(), theta)
    assert not isinstance(raised.value, NotImplementedError)


# Bad input.


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"steps": [0, 2, 2, 6]}, "steps must .* increase strictly"),
        ({"steps": [-1, 2, 3, 6]}, "steps must not be negative"),
        ({"steps": [0, 2, 3]}, "observed must have a row for each step"),
        ({"observed": PAIR_DATA[:, :1]}, "a column for each observable"),
    ],
)
@pytest.mark.parametrize("kind", [LogLikelihood, LogLikelihoodGradient])
def test_records_that_do_not_fit_are_refused_before_machine_code_reads_them(kind, changed, message):
    values = inputs(**changed)
    values += (np.ones(4),) if kind is LogLikelihoodGradient else ()
    with pytest.raises(ModelError, match=message):
        evaluator(kind(PAIR, psf.EKF()))(*values)


@pytest.mark.parametrize(
    ("system", "force", "message"),
    [
        (FORCED, np.zeros((5, 1)), "too few rows"),
        (FORCED, np.zeros((6, 2)), "one column for each input"),
        (forced(observation=lambda x, u: [x[0] + u[0]]), np.zeros((6, 1)), "too few rows"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(system, force, message):
    evaluate = evaluator(LogLikelihood(system, psf.EKF()))
    one = np.array([0.5])
    record = one, STEPS, np.zeros((4, 1))
    with pytest.raises(ModelError, match=message):
        evaluate(*record, force, np.array(0.0), np.array(0))
    evaluate(*record, np.zeros((7, 1)), np.array(0.0), np.array(0))


def test_inputs_of_the_wrong_rank_are_refused():
    with pytest.raises(TypeError, match="theta must have 1 dimensions"):
        LogLikelihood(PAIR, psf.EKF())(pt.dmatrix(), *inputs()[1:])
