"""`select_terms` on systems with hidden states, against other ways to the same probabilities.

``python -m benchmarks.terms_of_systems CASE COUNT`` runs one of

* ``chain``: three masses in a row with five candidate dampers, two of them absent; the evidences of
  all 32 sub-models by adaptive importance sampling from `log_likelihood`;
* ``oscillator``: the mass with three nonlinearities of `examples/thesis`, in its eight variants,
  from draws of `sample_smc`; their evidences by eight chains and `chib_jeliazkov`;
* ``double_well``: eight terms of a drift, by `BootstrapPF` and by `GridFilter`, which is exact;
* ``neuron``, ``neuron_v``: twenty terms of the equations of FitzHugh and Nagumo, with both states
  measured or the voltage alone; another run with another seed.

and prints, of so many records, for each candidate whether it is there, its probability with its
error, and the other number with its error; then CPU seconds of the two ways, and the mean z^2 of
the differences of probabilities between 0.02 and 0.98.

``chain``, record 1: probabilities of the three dampers that are there 0.995, 0.947 and 0.978, of
the others 0.209 and 0.486; mean z^2 0.7; of records 6 to 10 1.2, of 16 probabilities.

``oscillator``, record 2: cubic, freeplay and hysteresis have the probabilities 0.925, 0.66 and 0.69
by bridge sampling and importance sampling of long chains. Three seeds found 0.921 to 0.937, 0.628
to 0.722 and 0.696 to 0.752, with errors of at most 0.009, 0.025 and 0.022, in 17 CPU s with the
draws; eight chains and `chib_jeliazkov` 0.927, 0.698 and 0.712, with errors of 0.004, 0.013 and
0.013, in 306. All warn, of heavy tails of weights or of chains that disagree.

``double_well``, record 1: all eight terms have probabilities of 0.59 to 0.68 by `GridFilter`, and
`BootstrapPF` differs by 0.008 at most, mean z^2 1.3; 60 CPU s, and 767 by the grid.

``neuron``, records 2 to 5: the four terms of the first equation have probability 1.00, its false
ones 0.20 at most. Coefficients of the second one are 0.06 to 0.08, where the slab has the standard
deviation 1: they are found in none of the four, and ``b[v^3]`` takes their place in all. Mean z^2
0.05, so that errors of chains that mix slowly are too wide; 93 CPU s, 202 at most.

``neuron_v``, record 1: the draws of the full model, of which 200 are worth two, are no guide, and
the chains start with no terms. Of the first equation ``w`` has the probabilities 0.93 and 0.94 by
the two seeds, ``v`` 0.60 and 0.62, ``v^3`` 0.48 and 0.53; of the second one ``w`` 0.68 and 0.67,
``v^2 w`` 0.68 and 0.61, ``v^3`` 0.25 and 0.29; other terms 0.22 at most. No two differ by more than
0.07, with errors of up to 0.24; mean z^2 0.02 of 16, and 176 CPU s. The probability is spread over
hundreds of sub-models, the best of which has 0.09. Of 51 to which a run gives more than 0.004,
seven have evidences that are apart by 0.8 to 3 nats, each with fewer than ten effective points in
one of the runs; both warn of few effective points or of heavy tails, in sub-models with 6 % and
19 % of the probability.
"""

import logging
import sys
import time
import warnings
from dataclasses import replace
from itertools import compress, product
from pathlib import Path

import numpy as np
import pymc as pm
from scipy.special import betaln, logsumexp
from scipy.stats import halfnorm, multivariate_t, norm

import pymc_statespace_filters as psf

EXAMPLES = Path(__file__).parents[1] / "examples"
QUIET = {"progressbar": False}


# A chain of masses. A damper i joins a mass to the ground, or two masses.

ROWS = np.arange(1, 201)
PUSH = 2 * np.column_stack([0 * ROWS, 0 * ROWS, np.sin(0.05 * ROWS) + np.sin(0.11 * ROWS)])
JOINS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [0, 1, -1]])
DAMPERS = np.array([0.3, 0.0, 0.0, 0.2, 0.4])
SLAB, STIFFNESS = 0.5, (4.0, 1.0)
N_POINTS = 2000  # of each fit


def _matrix(factors):
    """The matrix of links with these factors."""
    return sum(f * np.outer(join, join) for f, join in zip(factors, JOINS, strict=True))


CHAIN = psf.StateSpaceModel(
    transition=psf.SemiImplicitEuler(
        psf.mechanics.second_order(
            np.eye(3),
            lambda c: _matrix([c[i] for i in range(len(JOINS))]),
            lambda k: k * _matrix([1, 0, 1, 1, 1]),
        ),
        [[0.0]] * 3 + [[0.1]] * 3,
        dt=0.05,
        velocities=["v0", "v1", "v2"],
    ),
    observation=lambda x: [x[0], x[2]],
    observation_noise=[[0.05**2, 0.0], [0.0, 0.05**2]],
    initial_mean=[0.0] * 6,
    initial_cov=np.eye(6) * 0.01,
    states=["q0", "q1", "q2", "v0", "v1", "v2"],
    inputs=["f0", "f1", "f2"],
    shapes={"c": (len(JOINS),)},
)


def chain(seed):
    truth = {"c": DAMPERS, "k": STIFFNESS[0]}
    record = psf.simulate(CHAIN, truth, steps=ROWS, inputs=PUSH, random_seed=seed)["observations"]
    with pm.Model() as model:
        pm.HalfNormal("c", SLAB, shape=len(JOINS))
        pm.Normal("k", *STIFFNESS)
        psf.StateSpace("d", CHAIN, psf.EKF(), steps=ROWS, inputs=PUSH, observed=record)
    terms, seconds = selected(model, {"c": 0.0}, seed)
    began = time.process_time()
    sets = (np.arange(2 ** len(JOINS))[:, None] >> np.arange(len(JOINS)) & 1).astype(bool)
    evidence, error = np.array([chain_evidence(one, record, seed) for one in sets]).T
    other = by_evidence(sets, evidence, error)
    return DAMPERS != 0, terms, other, (seconds, time.process_time() - began)


def chain_evidence(present, record, seed):
    """Log-evidence and error: a Student density, fitted to its own points until it is good."""
    rng, columns = np.random.default_rng(seed), np.append(np.flatnonzero(present), len(JOINS))
    mean = np.append(DAMPERS + 0.1, STIFFNESS[0])[columns]
    cov = np.diag(np.append(np.full(present.sum(), 0.2), 0.1) ** 2)
    for power in (0.03, 0.1, 0.3, 1.0, 1.0, 1.0, 1.0):
        x = np.zeros((N_POINTS, len(JOINS) + 1))
        law = multivariate_t(mean, cov, df=6, seed=rng)
        x[:, columns] = np.reshape(law.rvs(N_POINTS), (N_POINTS, -1))
        logs = chain_density(x, present, record) - law.logpdf(x[:, columns])
        weights = np.exp(power * (logs - logs.max()))
        weights /= weights.sum()
        mean = weights @ x[:, columns]
        centred = x[:, columns] - mean
        cov = (weights * centred.T) @ centred + 1e-8 * np.eye(len(columns))
    return logsumexp(logs) - np.log(N_POINTS), np.sqrt((weights**2).sum() - 1 / N_POINTS)


def chain_density(x, present, record):
    """The log of likelihood and prior at points, which have a value of each damper and k."""
    inside = (x[:, :-1] >= 0).all(axis=1)
    given = {"c": x[inside, :-1], "k": x[inside, -1]}
    found = np.full(len(x), -np.inf)
    found[inside] = psf.log_likelihood(
        CHAIN, psf.EKF(), given, record, steps=ROWS, inputs=PUSH
    ).sum(axis=-1)
    found += halfnorm(scale=SLAB).logpdf(x[:, :-1])[:, present].sum(axis=1)
    return found + norm(*STIFFNESS).logpdf(x[:, -1])


# The thesis's mass on a spring.


def oscillator(seed):
    sys.path.insert(0, str(EXAMPLES / "thesis"))
    from oscillator import CASES as RECORDS
    from oscillator_models import model_of

    case = replace(RECORDS["case 3"], seed=532 + seed)
    absent = {
        "cubic": {"k_nl": 0.0},
        "freeplay": {("slack", "delta_f"): (0.0, 0.5)},
        "hysteresis": {("friction", "delta_h", "a_h"): (0.0, 1.0, 0.5)},
    }
    kernel = {"stages": (3, 1)}
    full, began = model_of(case, psf.EKF()), time.process_time()
    # Chains of the full model need a million iterations for 100 effective draws.
    idata = psf.sample_smc(1000, model=full, random_seed=seed, progressbar=False)
    candidates = {key: at for one in absent.values() for key, at in one.items()}
    terms, _ = selected(full, candidates, seed, idata=idata)
    seconds, began = time.process_time() - began, time.process_time()
    sets = np.array(list(product([False, True], repeat=len(absent))))
    found = []
    for present in sets:
        model = model_of(case, psf.EKF(), tuple(compress(absent, present)))
        idata = psf.sample(model=model, random_seed=seed, kernel=kernel, **QUIET)
        found.append(psf.chib_jeliazkov(idata, model, random_seed=seed, progressbar=False))
    other = by_evidence(
        sets, np.array([one.log_evidence for one in found]), np.array([one.se for one in found])
    )
    return [True] * 3, terms, other, (seconds, time.process_time() - began)


# A double well.

LIBRARY = psf.mechanics.polynomial_terms(
    "x",
    3,
    also={
        "|x| x": lambda x: abs(x) * x,
        "sin 3x": lambda x: np.sin(3 * x),
        "tanh 3x": lambda x: np.tanh(3 * x),
        "1 / (1 + x^2)": lambda x: 1 / (1 + x**2),
    },
)
WELL = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x, a: [a @ LIBRARY(x)], [[0.6]], dt=0.1),
    observation=lambda x: [x[0]],
    observation_noise=[[0.2**2]],
    initial_mean=[1.0],
    initial_cov=[[0.1]],
    states=["x"],
    shapes={"a": (len(LIBRARY),)},
)
WELL_ROWS = np.arange(2, 161, 2)


def double_well(seed):
    present = np.isin(LIBRARY.names, ["x", "x^3"])
    truth = {"a": np.where(present, np.where(np.array(LIBRARY.names) == "x", 2.0, -2.0), 0.0)}
    record = psf.simulate(WELL, truth, steps=WELL_ROWS, random_seed=seed)["observations"]
    found = []
    for filter in (psf.BootstrapPF(200), psf.GridFilter()):
        with pm.Model(coords={"term": LIBRARY.names}) as model:
            pm.Normal("a", 0, 2, dims="term")
            psf.StateSpace("d", WELL, filter, steps=WELL_ROWS, observed=record)
        found.append(selected(model, {"a": 0.0}, seed, draws=400, until_ess=None))
    (terms, seconds), (other, other_seconds) = found
    return present, terms, other, (seconds, other_seconds)


# A neuron.


def neuron(seed, rows=500, measured=2):
    sys.path.insert(0, str(EXAMPLES))
    from terms import TRUTH, full_model, simulated

    library = psf.mechanics.polynomial_terms(["v", "w"], 3)
    record = simulated(rows, seed)
    record["observations"][:, measured:] = np.nan
    model = full_model(library, record, shrunk=False)
    idata = psf.sample(500, tune=500, chains=2, model=model, random_seed=seed, **QUIET)
    found = [
        selected(model, dict.fromkeys(TRUTH, 0.0), seed + more, idata=idata) for more in (0, 1000)
    ]
    (terms, seconds), (other, other_seconds) = found
    present = [name in terms_of for terms_of in TRUTH.values() for name in library.names]
    return present, terms, other, (seconds, other_seconds)


def neuron_v(seed):
    return neuron(seed, measured=1)


def selected(model, absent, seed, idata=None, **sampling):
    """Probabilities and errors, labels, and the CPU seconds; with draws of ``sampling``."""
    began = time.process_time()
    if idata is None:
        idata = psf.sample(model=model, random_seed=seed, **sampling, **QUIET)
    terms = psf.select_terms(model, absent, idata=idata, random_seed=seed, **QUIET)["terms"]
    found = terms["inclusion"].to_series(), terms["inclusion_se"].to_series()
    return found, time.process_time() - began


def by_evidence(sets, log_evidence, error):
    """Probabilities of terms (K,) by evidences of all sub-models (S,), with their errors."""
    size = sets.sum(axis=1)
    logs = log_evidence + betaln(size + 1, sets.shape[1] - size + 1)
    p = np.exp(logs - logsumexp(logs))
    return p @ sets, np.sqrt((p * error) ** 2 @ (sets - p @ sets) ** 2)


def main(case, count, first=1):
    """Print what records from a seed on say."""
    logging.getLogger("pymc").setLevel(logging.ERROR)
    squares, seconds = [], []
    for seed in range(first, first + count):
        with warnings.catch_warnings(record=True) as caught:
            present, (p, se), (other, other_se), spent = CASES[case](seed)
        print(f"{case}, seed {seed}; CPU s {spent[0]:.0f} and {spent[1]:.0f}")
        for is_there, name, *numbers in zip(present, p.index, p, se, other, other_se, strict=True):
            print(f"{'+' if is_there else ' '} {name:20}" + "".join(f"{x:9.4f}" for x in numbers))
        for one in {str(each.message) for each in caught}:
            print("  warned:", one)
        inside = (p > 0.02) & (p < 0.98)
        squares += list(((p - other) ** 2 / (se**2 + np.square(other_se)))[inside])
        seconds.append(spent)
        print(f"mean z^2 {np.mean(squares):.2f} of {len(squares)}", flush=True)
    print("CPU seconds of a record:", np.mean(seconds, axis=0).round(1))


CASES = {one.__name__: one for one in (chain, oscillator, double_well, neuron, neuron_v)}

if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:4]))
