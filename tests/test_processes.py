"""Compiled models in other processes: children of every kind, and the machine code kept on disk."""

import json
import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cloudpickle
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from tests.systems import FORCED, FORCED_DATA, PAIR, PAIR_DATA, STEPS, forced_terms
from tests.waiting import LIMIT

ROOT = Path(__file__).parents[1]
POINT = {"a": np.array(0.6)}


def evaluate(pickled, point):
    """Call a pickled function of a point."""
    return pickle.loads(pickled)(point)


def compiled(filter):
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, filter, steps=STEPS, observed=PAIR_DATA)
    return model.compile_logp()


@pytest.fixture(scope="module")
def densities():
    return [compiled(filter) for filter in (psf.EKF(), psf.EnKF(20))]


def chain_of(pickled):
    """Points of a chain by a pickled step method and its start."""
    step, point = pickle.loads(pickled)
    step.setup_chain(np.random.default_rng(5), tune=30, draws=0)
    points = []
    for _ in range(30):
        point, _ = step.step(point)
        points.append(float(point["a"]))
    return points


@pytest.fixture(scope="module")
def dram():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, psf.EnKF(20), steps=STEPS, observed=PAIR_DATA)
        return psf.DRAM(), model.initial_point()


@pytest.mark.filterwarnings("ignore:.*use of fork\\(\\) may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize(
    "method", ["fork", pytest.param("forkserver", marks=pytest.mark.slow), "spawn"]
)
def test_a_compiled_model_gives_the_same_bits_in_a_child(method, densities, dram):
    """Evaluated, and in a chain by DRAM, whose proposals have noise of their own."""
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} on this platform")
    context = multiprocessing.get_context(method)
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        calls = [pool.submit(evaluate, cloudpickle.dumps(logp), POINT) for logp in densities]
        chain = pool.submit(chain_of, cloudpickle.dumps(dram))
        there = [call.result(timeout=LIMIT) for call in calls]
    here = chain_of(cloudpickle.dumps(dram))
    assert chain.result(timeout=LIMIT) == here
    assert len(set(here)) > 3
    assert there == [logp(POINT) for logp in densities]


UNPICKLE = """
import sys
import cloudpickle
model = cloudpickle.load(sys.stdin.buffer)
print(repr(float(model.compile_logp()({"a": 0.6}))))
"""


def test_a_pickled_model_is_whole_where_nothing_was_imported(densities):
    """Public names are imported on first use; what draws and evaluates a variable comes with it."""
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
    done = subprocess.run(
        [sys.executable, "-c", UNPICKLE],
        input=cloudpickle.dumps(model),
        capture_output=True,
        timeout=LIMIT,
        check=True,
    )
    assert float(done.stdout) == float(densities[0](POINT))


# What a script of the user's does, in a process of its own: settings on the command line.
SCRIPT = """
import json, sys
import numpy as np, pymc as pm
import pymc_statespace_filters as psf
from pytensor.link.numba.cache import NUMBA_CACHE_PATH
from pymc_statespace_filters.compiler.native import entry_point as entries
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from tests.systems import FORCE, FORCED_DATA, STEPS, forced

def terms(system, observed):
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace(
            "d", forced(**system), psf.EKF(), steps=STEPS, observed=observed, inputs=FORCE
        )
    return model.compile_logp([model["d"]], sum=False)({"a": np.array(0.6)})[0].tolist()

first, *others = json.loads(sys.argv[1])
drawn = psf.simulate(forced(), {"a": 0.6}, steps=STEPS, inputs=FORCE, random_seed=1)
values = [
    terms(*first), drawn["observations"].values.tolist(),
    kernel(LogLikelihood(forced(), psf.EKF())).key,
]
found = [entry.cache_hits for entry in entries._compiled.values()]
files = sorted(path.name for path in NUMBA_CACHE_PATH.rglob("*.nb[ci]"))
print(json.dumps([values, found, files, [terms(*other) for other in others]]))
"""


@pytest.fixture
def run(tmp_path):
    """Run the script on a cache of machine code that only this test has."""
    cache = tmp_path / "cache"

    def run(*cases):
        flags = f"base_compiledir={cache.as_posix()},blas__ldflags=,cxx="
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", SCRIPT, json.dumps(cases)],
            cwd=ROOT,
            env=os.environ | {"PYTENSOR_FLAGS": flags, "PYTHONHASHSEED": "random"},
            capture_output=True,
            timeout=LIMIT,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def test_machine_code_is_found_again_and_never_mixed_up(run):
    """A second process compiles nothing; other data and constants meet what the first one kept."""
    data, other_data = FORCED_DATA.tolist(), (2 * FORCED_DATA).tolist()
    cold, found, machine_code, _ = run([{}, data])
    terms, _, key = cold
    assert machine_code
    assert len(found) > 1
    assert not any(found)
    np.testing.assert_allclose(terms, forced_terms(0.6), rtol=1e-12)

    warm, found_again, same_machine_code, (other,) = run(
        [{}, data], [{"observation_noise": [[0.6]]}, other_data]
    )
    assert same_machine_code == machine_code
    assert found_again == [1] * len(found)
    assert key == kernel(LogLikelihood(FORCED, psf.EKF())).key
    assert warm == cold
    exact = forced_terms(0.6, other_data, observation_noise=0.6)
    np.testing.assert_allclose(other, exact, rtol=1e-12)
