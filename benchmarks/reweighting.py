"""Draws of a fast filter corrected by an unbiased one, beside chains with the unbiased filter.

Three systems: the double well with wide noise, where both wells are probable; Poisson counts; and
a Duffing oscillator with a bent sensor. Of each, one parameter is estimated first, so that the
exact posterior is known by quadrature. Then all parameters: what an effective draw costs.

Run it with ``python -m benchmarks.reweighting`` from the root of the repository; it takes some ten
minutes and prints the tables of ``docs/howto/reweight.md``. Seconds are those of the CPU.
"""

import logging
import time
from collections.abc import Callable
from typing import NamedTuple

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters.written import short_form

DRAWS = 1000  # of the fast filter, weighted
WIDTH = 0.5  # of the prior of the logarithm of a scale


class Case(NamedTuple):
    """A system with data, priors of its parameters, and filters."""

    name: str
    system: psf.StateSpaceModel
    steps: np.ndarray
    truth: dict[str, float]
    single: str  # the parameter that is estimated alone
    fast: object
    unbiased: object
    reference: object  # exact, or with so little noise that it may count as exact


def _drift(x, alpha, beta):
    return [alpha * x[0] + beta * x[0] ** 3]


DOUBLE_WELL = psf.StateSpaceModel(
    psf.EulerMaruyama(_drift, lambda sigma: [[sigma]], dt=0.01),
    observation=lambda x: [x[0]],
    observation_noise=[[0.5]],
    initial_mean=[0.0],
    initial_cov=[[0.5]],
)
COUNTS = psf.StateSpaceModel(
    lambda x, q, a, s: [a * x[0] + s * q[0]],
    process_noise=[[1.0]],
    observation_dist=lambda x, level: [pm.Poisson.dist(mu=pt.exp(level + x[0]))],
    initial_mean=[0.0],
    initial_cov=[[0.5]],
)
DUFFING = psf.StateSpaceModel(
    psf.SemiImplicitEuler(
        lambda x, k, c: [x[1], -k * x[0] - x[0] ** 3 - c * x[1]],
        lambda s: [[0.0], [s]],
        dt=0.05,
        velocities=[1],
    ),
    observation=lambda x: [x[0] + 0.3 * x[0] ** 2],
    observation_noise=[[0.3]],
    initial_mean=[1.0, 0.0],
    initial_cov=0.1 * np.eye(2),
)
CASES = (
    Case("double well", DOUBLE_WELL, np.arange(20, 2001, 20),
         {"alpha": 4.0, "beta": -4.0, "sigma": 1.0}, "sigma",
         psf.EKF(), psf.BootstrapPF(100), psf.GridFilter()),
    Case("counts", COUNTS, np.arange(1, 101), {"a": 0.8, "s": 0.5, "level": 0.5}, "s",
         psf.IPLF(), psf.BootstrapPF(100), psf.GridFilter()),
    Case("Duffing", DUFFING, np.arange(5, 501, 5), {"k": 1.0, "c": 0.2, "s": 0.7}, "s",
         psf.EKF(), psf.GuidedPF(50), psf.GuidedPF(2000)),
)  # fmt: skip


def record_of(case: Case) -> np.ndarray:
    """Simulated data of a case."""
    run = psf.simulate(case.system, case.truth, steps=case.steps, random_seed=3)
    return run["observations"].values


def model_of(case: Case, filter: object, names: list[str]) -> pm.Model:
    """Normal priors as wide as the parameters are large, log-normal ones of scales."""
    with pm.Model() as model:
        params: dict = dict(case.truth)
        for name in names:
            value = case.truth[name]
            positive = name in ("sigma", "s")
            params[name] = (
                pm.LogNormal(name, np.log(value), WIDTH)
                if positive
                else pm.Normal(name, value, abs(value))
            )
        psf.StateSpace(
            "d", case.system, filter, params=params, steps=case.steps, observed=record_of(case)
        )
    return model


def timed(function: Callable) -> tuple[object, float]:
    """The second of two calls, without compilation."""
    function()
    start = time.process_time()
    found = function()
    return found, time.process_time() - start


def by_quadrature(case: Case, logs: np.ndarray) -> tuple[float, float, float]:
    """Mean, standard deviation and log-evidence of the single parameter, by the reference.

    ``logs`` are draws of its logarithm, which say where the grid lies.
    """
    x = logs.mean() + np.linspace(-7, 7, 121) * logs.std()
    n_seeds = 10 if case.reference.noisy else 1
    terms = psf.log_likelihood(
        case.system,
        case.reference,
        case.truth | {case.single: np.exp(x[:, None])},
        record_of(case),
        steps=case.steps,
        seed=np.arange(n_seeds),
    ).sum(axis=-1)
    log_joint = norm.logpdf(x, np.log(case.truth[case.single]), WIDTH)
    log_joint += logsumexp(terms, axis=1) - np.log(terms.shape[1])
    weights = np.exp(log_joint - logsumexp(log_joint))
    mean = weights @ np.exp(x)
    sd = np.sqrt(weights @ (np.exp(x) - mean) ** 2)
    return mean, sd, float(logsumexp(log_joint) + np.log(x[1] - x[0]))


def single_parameter(case: Case) -> str:
    """A row of the first table: corrected draws and evidence beside quadrature."""
    model = model_of(case, case.fast, [case.single])
    draws = psf.sample_dram(1000, model=model, random_seed=1, progressbar=False)
    exact = psf.reweight(
        draws, model, filter=case.unbiased, n_draws=DRAWS, random_seed=2, progressbar=False
    )
    evidence = psf.estimate_evidence(
        draws, model, filter=case.unbiased, random_seed=3, progressbar=False
    )["importance"]
    before, after = (tree["posterior"][case.single].values for tree in (draws, exact))
    mean, sd, log_evidence = by_quadrature(case, np.log(after))
    error = sd * exact.attrs["effective_size"] ** -0.5
    return (
        f"| {case.name}, {case.single} | {before.mean():.3f} ± {before.std():.3f} | "
        f"{after.mean():.3f} ± {after.std():.3f} | {error:.3f} | {mean:.3f} ± {sd:.3f} | "
        f"{evidence.log_evidence:.2f} ± {evidence.se:.2f} | {log_evidence:.2f} |"
    )


def all_parameters(case: Case) -> str:
    """A row of the second table: the cost of an effective draw."""
    names = list(case.truth)
    fast, exact = model_of(case, case.fast, names), model_of(case, case.unbiased, names)
    settings = {"random_seed": 1, "progressbar": False, "cores": 1}
    draws, of_draws = timed(lambda: psf.sample_dram(1000, model=fast, **settings))
    weighted, of_weights = timed(
        lambda: psf.reweight(draws, fast, filter=case.unbiased, n_draws=DRAWS, **settings)
    )
    attrs = weighted.attrs
    moved = max(
        abs(float(weighted["posterior"][n].mean() - draws["posterior"][n].mean()))
        / float(draws["posterior"][n].std())
        for n in names
    )
    costs = [_cost(of_draws + of_weights, attrs["effective_size"])]
    for screen in (None, case.fast):
        chains, of_chains = timed(
            lambda screen=screen: psf.sample_dram(
                1000,
                200,
                model=exact,
                pilot=draws,
                kernel={"screen": screen},
                **settings,
            )
        )
        ess = min(float(az.ess(chains["posterior"][name].values)) for name in names)
        costs.append(_cost(of_draws + of_chains, ess))
    return (
        f"| {case.name}, `{short_form(case.unbiased)}` | {moved:.2f} | "
        f"{attrs['log_weight_sd']:.1f} | {attrs['pareto_k']:.2f} | {attrs['beyond_draws']:.1%} | "
        f"{attrs['n_seeds']} | {' | '.join(costs)} |"
    )


def _cost(seconds: float, ess: float) -> str:
    return f"{ess:.0f} in {seconds:.1f} s | {1000 * seconds / ess:.0f}"


def main() -> None:
    """Print both tables."""
    logging.getLogger("pymc").setLevel(logging.ERROR)
    print("| case | fast | corrected | error of the mean | exact | log-evidence | exact |")
    for case in CASES:
        print(single_parameter(case), flush=True)
    columns = "case", "moved", "spread", "k", "beyond", "seeds", "reweight", "ms", "chains", "ms"
    print(f"\n| {' | '.join(columns)} | with a screen | ms |")
    for case in CASES:
        print(all_parameters(case), flush=True)


if __name__ == "__main__":
    main()
