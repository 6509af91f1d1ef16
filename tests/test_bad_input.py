"""What users get wrong is an error that names the argument, its value and what is expected."""

import numpy as np
import pandas as pd
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf


def make(**changes):
    """A small valid system with some of its arguments replaced."""
    arguments = dict(
        transition=lambda x, q, a: [a * x[0] + q[0], x[1]],
        process_noise=[[0.1]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.5]],
        initial_mean=[0.0, 1.0],
        initial_cov=np.eye(2),
    )
    arguments = {k: v for k, v in (arguments | changes).items() if v is not ...}
    return psf.StateSpaceModel(**arguments)


def euler(drift=lambda x, a: [a * x[0], x[1]], diffusion=((0.1,), (0.0,)), dt=0.1, **settings):
    step = psf.EulerMaruyama(drift, diffusion, dt, **settings)
    return make(transition=step, process_noise=...)


def branching(x):
    return [x[0] if x[0] > 0 else -x[0], x[1]]


def forgetful(x, q):
    x[0] + q[0]


OUTSIDE = pytensor.shared(np.array(2.0), name="gain")

SYSTEMS = {
    # shapes that disagree
    "transition too short": (dict(transition=lambda x, q: [x[0]]), r"transition .*\(2,\).*\(1,\)"),
    "transition a number": (dict(transition=lambda x, q: x[0]), "transition .*one expression per"),
    "transition nested": (dict(transition=lambda x, q: [x]), "transition .*2 dimensions"),
    "ragged list": (
        dict(transition=lambda x, q: [x[0], x]), "transition must return entries of one shape",
    ),
    "observation empty": (dict(observation=lambda x: []), "observation .*at least one|must have"),
    "noise of other size": (dict(observation_noise=np.eye(2)), r"observation_noise .*\(1, 1\)"),
    "initial_cov of other size": (dict(initial_cov=[[1.0]]), r"initial_cov .*\(2, 2\).*\(1, 1\)"),
    "initial_cov a vector": (dict(initial_cov=[1.0, 1.0]), r"initial_cov .*square.*\(2,\)"),
    "initial_mean a number": (dict(initial_mean=0.0), r"initial_cov .*\(1, 1\), got \(2, 2\)"),
    "initial_mean a matrix": (dict(initial_mean=[[0.0, 1.0]]), "initial_mean .*vector"),
    "initial_mean empty": (dict(initial_mean=[]), "initial_mean"),
    "covariance function": (
        dict(process_noise=lambda s: [[s, 0.0]]), r"process_noise .*(\(1, 1\)|square|\(2, 2\))",
    ),
    "initial_cov function": (dict(initial_cov=lambda s: [[s]]), r"initial_cov .*\(2, 2\)"),
    "unpacked too many": (dict(observation=lambda x: [_third(x)]), "observation .*unpack"),
    "index too large": (dict(observation=lambda x: [x[2]]), "index x from 0 to 1, got the index 2"),
    "observable names": (dict(observables=["a", "b"]), "observ"),
    "state names": (dict(states=["a"]), r"states .*2.*\['a'\]"),
    "state names a word": (dict(states="ab"), "states .*list of names"),
    "names twice": (dict(states=["a", "a"]), "states .*distinct"),
    # covariances
    "not symmetric": (dict(initial_cov=[[1.0, 0.5], [0.0, 1.0]]), "initial_cov .*symmetric"),
    "negative": (dict(process_noise=[[-0.1]]), "process_noise .*-0.1.*eigenvalue"),
    "indefinite": (dict(initial_cov=[[1.0, 2.0], [2.0, 1.0]]), "initial_cov .*eigenvalue"),
    "not finite": (dict(observation_noise=[[np.nan]]), "observation_noise .*finite"),
    "words": (dict(observation_noise=[["a"]]), "observation_noise .*numbers"),
    "a bare variance": (
        dict(observation=lambda x: x, observation_noise=0.5),
        r"observation_noise .*square matrix.*\(\)",
    ),
    "a bare variance of two states": (dict(initial_cov=1.0), r"initial_cov .*square matrix.*\(\)"),
    "infinite mean": (dict(initial_mean=[0.0, np.inf]), "initial_mean .*finite"),
    # reserved names and signatures
    "e in the transition": (dict(transition=lambda x, e: x), "transition.*'e' is reserved"),
    "q in the observation": (dict(observation=lambda x, q: [x[0]]), "observation.*'q' is reserved"),
    "x in a covariance": (dict(initial_cov=lambda x: [[x]]), "initial_cov.*'x' is reserved"),
    "default of x": (dict(transition=lambda q, x=1.0: x), "'x' must have no default, got 1.0"),
    "star arguments": (dict(transition=lambda *args: args[0]), r"transition.*\*args"),
    "star keywords": (dict(transition=lambda x, **kw: x), r"transition.*\*\*kw"),
    "a word as default": (dict(transition=lambda x, q, a="b": x), "default of 'a' .*'b'"),
    "None as default": (dict(transition=lambda x, q, a=None: x), "default of 'a' .*None"),
    "an infinite default": (
        dict(transition=lambda x, q, K=np.inf: x * (1 - x / K)),
        r"default of 'K' .*finite number, got inf; .*inverse_K = 1 / K, and the default 0",
    ),
    "two defaults": (
        dict(transition=lambda x, q, a=1.0: a * x, observation=lambda x, a=2.0: [a * x[0]]),
        "'a' must have one default",
    ),
    "default of another shape": (
        dict(transition=lambda x, q, a=(1.0, 2.0): a * x), r"default of 'a' .*\(2,\).*shapes",
    ),
    "u without inputs": (
        dict(observation=lambda x, u: [u[0]]), "observation has the argument u.*inputs=",
    ),
    "q without its covariance": (
        dict(process_noise=...), "process_noise must be the covariance of q.*got None",
    ),
    "process noise without q": (
        dict(transition=lambda x: x), "process_noise .*transition does not have the argument q",
    ),
    "inputs nobody asks for": (dict(inputs="force"), "inputs .*list of names"),
    "unknown carried": (dict(carried=["branch"]), r"carried must name states, .*got \['branch'\]"),
    "unknown shape": (dict(shapes={"k": (2,)}), r"shapes .*\['a'\], got \['k'\]"),
    "bad shape": (dict(shapes={"a": 2}), r"shapes\['a'\] .*2"),
    # what is returned, and how
    "returns None": (dict(transition=forgetful), "transition must return .*, got None"),
    "returns a word": (dict(observation=lambda x: ["x"]), "observation must return .*, got 'x'"),
    "an array of symbols": (
        dict(transition=lambda x, q: np.array([x[0], x[1]])), "transition .*numpy array of symbols",
    ),
    "numpy on symbols": (dict(transition=lambda x, q: np.roll(x, 1)), "transition .*numpy"),
    "python branch": (dict(transition=branching, process_noise=...), r"transition .*pt\.switch"),
    "python float": (dict(observation=lambda x: [float(x[0])]), "observation .*traced"),
    "built-in max": (dict(observation=lambda x: [max(x[0], 0.0)]), r"observation .*pt\.switch"),
    "complex": (
        dict(observation=lambda x: [pt.sqrt(x[0] + 0j)]), "observation .*real numbers, got complex",
    ),
    "shared variable": (dict(observation=lambda x: [OUTSIDE * x[0]]), "shared variable gain"),
    "not a function": (dict(transition=3.0), "transition must be a function, got 3.0"),
    "string matrix": (dict(process_noise="Q"), "process_noise .*'Q'"),
    # observations
    "nothing observed": (dict(observation=...), "observation"),
    "noise of its own missing": (dict(observation_noise=...), "observation_noise"),
    "dist beside observation": (
        dict(observation_dist=lambda x: [pm.Poisson.dist(1.0)]), "observation_dist",
    ),
    "dist is no distribution": (
        dict(observation_dist=lambda x: [x[0]], observation=..., observation_noise=...),
        "observation_dist",
    ),
    "dist is a number": (
        dict(observation_dist=lambda x: [1.0], observation=..., observation_noise=...),
        "observation_dist .*scalar PyMC distribution",
    ),
    "dist is a vector": (
        dict(
            observation_dist=lambda x: [pm.Normal.dist(x, 1.0)], observation=...,
            observation_noise=...,
        ),
        "observation_dist .*scalar PyMC distribution",
    ),
    "logp without d": (
        dict(observation_logp=lambda x: x[0]), "observation_logp must have the argument d",
    ),
    "logp a vector": (dict(observation_logp=lambda d, x: x), "observation_logp .*one number"),
    # numbers
    "dt zero": (dict(dt=0.0), "dt .*positive.*0.0"),
    "dt a word": (dict(dt="fast"), "dt .*'fast'"),
    "dt true": (dict(dt=True), "dt .*True"),
}  # fmt: skip


def _third(x):
    _a, _b, c = x
    return c


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_wrong_system_is_refused_when_it_is_made(name):
    changes, words = SYSTEMS[name]
    with pytest.raises(psf.errors.ModelError, match=words) as caught:
        make(**changes)
    assert isinstance(caught.value, ValueError)


DRAWS_INSIDE = {
    "transition": (
        dict(transition=lambda x, q: [x[0] + q[0], pm.Binomial.dist(10, 0.5)]),
        "transition must be a deterministic .*binomial.* made inside it: .*argument q.*diffusion",
    ),
    "own generator": (
        dict(transition=lambda x, q: [pm.Normal.dist(rng=GENERATOR), x[1]]),
        "transition must be a deterministic .*normal.* made inside it",
    ),
    "observation": (
        dict(observation=lambda x: [pm.Normal.dist(x[0], 1.0)]),
        "observation must be a deterministic .*normal.*: noise of .*observation_dist",
    ),
    "initial_mean": (
        dict(initial_mean=lambda: [pm.Normal.dist(), 0.0]), "initial_mean .*normal.*initial_cov",
    ),
    "process_noise": (dict(process_noise=lambda: [[pm.Normal.dist()]]), "process_noise .*inside"),
    "a rate": (
        dict(
            observation_dist=lambda x: [pm.Poisson.dist(pm.Gamma.dist(2.0, 1.0))],
            observation=..., observation_noise=...,
        ),
        "observation_dist must be a deterministic .*gamma.*NegativeBinomial",
    ),
}  # fmt: skip
GENERATOR = pytensor.shared(np.random.default_rng(1), name="generator")


@pytest.mark.parametrize("name", DRAWS_INSIDE)
def test_a_function_that_draws_is_told_where_noise_belongs(name):
    changes, words = DRAWS_INSIDE[name]
    with pytest.raises(psf.errors.ModelError, match=words) as caught:
        make(**changes)
    assert "as a parameter" not in str(caught.value)


def test_a_drift_that_draws_is_told_of_the_diffusion():
    with pytest.raises(psf.errors.ModelError, match=r"normal.* made inside it: .*diffusion"):
        euler(drift=lambda x: [pm.Normal.dist(x[0], 1.0), x[1]])


def test_pymc_variables_are_not_constants():
    unnamed = pm.Normal.dist()
    with pytest.raises(psf.errors.ModelError, match=r"random variable .*as a parameter"):
        make(transition=lambda x, q: [unnamed + q[0], x[1]])
    with pm.Model():
        gain = pm.Normal("gain")
        with pytest.raises(psf.errors.ModelError, match=r"random variable gain.*as a parameter"):
            make(observation=lambda x: [gain * x[0]])


INTEGRATORS = {
    "dt negative": (lambda: euler(dt=-0.1), "dt .*positive.*-0.1"),
    "dt infinite": (lambda: euler(dt=np.inf), "dt .*positive.*inf"),
    "dt missing": (lambda: euler(dt=None), "dt .*None"),
    "no substeps": (lambda: euler(substeps=0), "substeps .*at least 1.*0"),
    "too many substeps": (lambda: euler(substeps=10**9), "substeps must be at most 1000"),
    "half a substep": (lambda: euler(substeps=1.5), "substeps .*integer.*1.5"),
    "drift too long": (lambda: euler(drift=lambda x: [x[0]]), r"drift .*\(2,\).*\(1,\)"),
    "drift with noise": (lambda: euler(drift=lambda x, q: x), "drift.*'q' is reserved"),
    "diffusion a vector": (lambda: euler(diffusion=[0.1, 0.2]), "diffusion .*matrix"),
    "diffusion of other size": (
        lambda: euler(diffusion=[[0.1]]),
        r"diffusion .*\(2, 1\).*\(1, 1\)",
    ),
    "diffusion not finite": (lambda: euler(diffusion=[[np.inf], [0.0]]), "diffusion .*finite"),
    "process_noise too": (
        lambda: make(transition=psf.EulerMaruyama(lambda x: x, np.eye(2), 0.1)),
        "process_noise .*integrator",
    ),
    "dt twice": (
        lambda: make(
            transition=psf.EulerMaruyama(lambda x: x, np.eye(2), 0.1), process_noise=..., dt=0.1
        ),
        "dt .*integrator.*0.1",
    ),
}


@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_wrong_integrator_is_refused(name):
    construct, words = INTEGRATORS[name]
    with pytest.raises(psf.errors.ModelError, match=words):
        construct()


SYSTEM = make()
FORCED = make(transition=lambda x, q, u, a: [a * x[0] + u[0] + q[0], x[1]], inputs=["force"])
SEEN_FORCE = make(
    transition=lambda x, u: x, process_noise=..., observation=lambda x, u: [x[0] + u[0]],
    inputs=["force"],
)  # fmt: skip
VECTOR = make(transition=lambda x, q, k: k * x + q[0], shapes={"k": (2,)})

RECORDS = {
    # steps and times
    "neither": (dict(steps=None), "observed brings no dates: give steps or times"),
    "both": (dict(times=[0.0, 1.0]), "exactly one of steps and times"),
    "empty": (dict(steps=[], observed=[]), "steps must hold at least one step"),
    "not increasing": (dict(steps=[1, 1]), r"steps\[0\] = 1 .*followed by 1"),
    "decreasing": (dict(steps=[2, 1]), r"steps\[0\] = 2 .*followed by 1"),
    "negative": (dict(steps=[-1, 1]), "steps must not be negative, got -1"),
    "floats": (dict(steps=[0.0, 1.0]), "steps .*integers"),
    "truths": (dict(steps=[False, True]), "steps .*integers"),
    "a number": (dict(steps=3, observed=[0.0]), "steps .*vector"),
    "off the grid": (dict(steps=None, times=[0.0, 1.5]), r"times\[1\] = .*1.5.*off the grid"),
    "before the start": (dict(steps=None, times=[-1.0, 1.0]), "before t0"),
    "times not finite": (dict(steps=None, times=[0.0, np.nan]), "times .*finite"),
    "times not numbers": (dict(steps=None, times=["now", "then"]), "times must be numbers"),
    "dates": (
        dict(steps=None, times=np.array(["2020-01-01", "2020-01-02"], "datetime64[D]")),
        'unit must be the duration .* such as unit="D"',
    ),
    "durations": (dict(steps=None, times=np.arange(2).astype("timedelta64[h]")), "times .*dates"),
    "index of dates": (dict(steps=None, times=pd.date_range("2020", periods=2)), "times .*dates"),
    "dates as text": (
        dict(steps=None, times=["2020-01-01", "2020-01-02"]), r"times .*text.*pd\.to_datetime",
    ),
    "times too far": (dict(steps=None, times=[0.0, 1e30]), "at most 1e.09, .*got 1e.30"),
    "steps too far": (dict(steps=[0, 10**12]), "at most 1e.09, .*got 1e.12"),
    "steps beyond 64 bits": (dict(steps=[0, 2**70]), "at most 1e.09"),
    "t0 not a number": (dict(t0="0"), "t0 .*'0'"),
    "t0 infinite": (dict(t0=np.inf), "t0 .*finite"),
    # data
    "data too short": (dict(observed=[0.0]), r"observed .*\(2, 1\).*\(1,\)"),
    "data too wide": (dict(observed=np.zeros((2, 2))), r"observed .*\(2, 1\).*\(2, 2\)"),
    "data infinite": (dict(observed=[0.0, np.inf]), r"observed .*NaN where missing.*inf"),
    "data words": (dict(observed=["a", "b"]), "observed must be numbers"),
    "data complex": (
        dict(observed=np.array([1.0, 1j])), "observed must be numbers, got .*1.j"
    ),  # of which numpy would leave out the imaginary parts
    "dates in a column": (
        dict(steps=None,
             observed=pd.DataFrame({"day": pd.date_range("2020", periods=2), "z": [0.0, 1.0]})),
        r"observed brings no dates.*its column 'day' has dates: \.set_index\('day'\)",
    ),
    # parameters
    "parameter missing": (dict(params={}), r"no value for the parameters \['a'\]"),
    "parameter unknown": (dict(params={"a": 1.0, "b": 2.0}), r"parameters .*\['a'\], got \['b'\]"),
    "parameter NaN": (dict(params={"a": np.nan}), "'a' must not be NaN"),
    "parameter masked": (
        dict(params={"a": np.ma.masked_array(0.5, True)}), "'a' must have no masked values",
    ),
    "parameter a word": (dict(params={"a": "big"}), "'a' must be numbers"),
    "not a mapping": (dict(params=[1.0]), "params must be a mapping"),
    "params must be arrays that broadcast together": (
        dict(system=make(transition=lambda x, q, a, b: a * b * x),
             params={"a": np.zeros(2), "b": np.zeros(3)}),
        "params must be arrays that broadcast together",
    ),
    "declared shape": (dict(system=VECTOR, params={"k": 1.0}), r"'k' must have shape .*2"),
    # inputs
    "inputs missing": (
        dict(system=FORCED), r"inputs must have a row per step .*\['force'\], got None",
    ),
    "inputs unasked": (dict(inputs=np.zeros(9)), "inputs must be None for a system without inputs"),
    "inputs too few": (
        dict(system=FORCED, inputs=np.zeros(2)), "inputs must have at least 3 rows.*got 2",
    ),
    "inputs too few if observed": (
        dict(system=SEEN_FORCE, params={}, inputs=np.zeros(3)), "at least 4 rows.*uses u.*got 3",
    ),
    "inputs too wide": (dict(system=FORCED, inputs=np.zeros((9, 2))), r"\(steps, 1\).*\(9, 2\)"),
    "inputs not finite": (dict(system=FORCED, inputs=np.full(9, np.nan)), "inputs .*finite"),
    # seeds
    "seed a float": (dict(seed=1.5), "seed must be an integer, got 1.5"),
    "seed a truth": (dict(seed=True), "seed must be an integer, got True"),
    "seeds of other shape": (
        dict(params={"a": np.zeros(2)}, seed=np.arange(3)), "seed of shape .*broadcast",
    ),
    # the things themselves
    "not a system": (dict(system=lambda x: x), "system must be a StateSpaceModel"),
    "filter a class": (dict(filter=psf.EKF), r"filter must be .*EKF\(\)"),
    "filter a word": (dict(filter="EKF"), "filter must be .*'EKF'"),
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDS)
def test_a_wrong_record_is_refused(name):
    changes, words = RECORDS[name]
    given = dict(
        system=SYSTEM, filter=psf.EKF(), params={"a": 0.5}, observed=[0.0, 1.0], steps=[0, 3]
    )
    given |= changes
    positional = [given.pop(k) for k in ("system", "filter", "params", "observed")]
    with pytest.raises(psf.errors.ModelError, match=words):
        psf.log_likelihood(*positional, **given)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(steps=[1, 0]), "followed by 0"),
        (dict(params={"a": [1.0, 2.0]}), "params must have one value per parameter"),
        (dict(params={}), "no value for the parameters"),
        (dict(random_seed="today"), "random_seed"),
        (dict(system="system"), "system must be a StateSpaceModel"),
    ],
)
def test_a_wrong_simulation_is_refused(changes, words):
    given = dict(system=SYSTEM, params={"a": 0.5}, steps=[0, 3]) | changes
    with pytest.raises(psf.errors.ModelError, match=words):
        psf.simulate(given.pop("system"), given.pop("params"), **given)


@pytest.mark.parametrize("name", [3, ""])
def test_a_variable_has_a_name(name):
    with pm.Model(), pytest.raises(psf.errors.ModelError, match="name must be a text"):
        psf.StateSpace(name, SYSTEM, psf.EKF(), params={"a": 0.5}, steps=[0], observed=[0.0])


def test_a_parameter_with_dims_is_given_by_element():
    with pm.Model(coords={"site": ["a", "b"]}):
        a = pm.Normal("a", dims="site")
        said = r"'a' must have shape \(\), got \(\?,\): give one element, params=\{'a': \.\.\.\}"
        with pytest.raises(psf.errors.ModelError, match=said):
            psf.StateSpace("d", SYSTEM, psf.EKF(), steps=[0], observed=[0.0])
        psf.StateSpace("d", SYSTEM, psf.EKF(), params={"a": a[0]}, steps=[0], observed=[0.0])


def _skewed(b):
    return [[1.0, b], [0.2 * b, 1.0]]


def _correlated(b):
    return [[1.0, 0.2 * b], [0.2 * b, 1.0]]


@pytest.mark.parametrize("role", ["process_noise", "observation_noise", "initial_cov"])
def test_functions_give_symmetric_covariances(role):
    """One triangle of the matrix is all that a filter reads."""
    both = dict(
        transition=lambda x, q: [x[0] + q[0], x[1] + q[1]],
        process_noise=np.eye(2),
        observation=lambda x: x,
        observation_noise=np.eye(2),
    )
    make(**both | {role: _correlated})
    with pytest.raises(psf.errors.ModelError, match=f"{role} must be symmetric, got .* parameters"):
        make(**both | {role: _skewed})


def test_a_density_alone_cannot_be_simulated():
    system = make(
        observation=..., observation_noise=..., observation_logp=lambda d, x: -(d[0] ** 2)
    )
    with pytest.raises(psf.errors.ModelError, match="simulating needs observation"):
        psf.simulate(system, {"a": 1.0}, steps=[1])


def test_filters_refuse_systems_that_they_cannot_treat():
    counts = make(
        observation=..., observation_noise=..., observation_dist=lambda x: [pm.Poisson.dist(1.0)]
    )
    memory = make(states=["z", "branch"], carried=["branch"])
    arguments = (
        {"a": 1.0},
        [1.0],
    )
    for filter in (psf.EKF(), psf.EnKF(10)):
        with pytest.raises(psf.errors.ModelError, match=r"GuidedPF.* BootstrapPF"):
            psf.log_likelihood(counts, filter, *arguments, steps=[0])
    with pytest.raises(psf.errors.ModelError, match=r"EKF .*\['branch'\]"):
        psf.log_likelihood(memory, psf.EKF(), *arguments, steps=[0])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ([0.0, 0.1, 0.104], 0.1),
            "times .*different steps of dt = 0.1, got 0.1 and 0.104: take a smaller dt",
        ),
        (([-0.2, 0.1], 0.1), "negative"),
        ((np.arange(2).astype("timedelta64[s]"), 0.1), "times .*dates"),
        (([0.0, 1e30], 0.1), "steps must be at most"),
        (([0.0, np.nan], 0.1), "times .*finite"),
        (([0.0, 0.1], 0.0), "dt must be a positive number, got 0.0"),
        (([0.0, 0.1], "0.1"), "dt must be a positive number, got '0.1'"),
    ],
)
def test_wrong_timestamps_are_refused(arguments, words):
    with pytest.raises(psf.errors.ModelError, match=words):
        psf.nearest_steps(*arguments)


def test_nothing_can_be_written_to_a_system():
    with pytest.raises(AttributeError, match="immutable"):
        SYSTEM.dt = 0.5
