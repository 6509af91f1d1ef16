"""How weak a missing force the evidence finds, by a free field and by its true form.

Forces are missing from linear oscillators that are driven by known inputs and by noise. Only
displacements are measured; stiffness and damping are drawn from their priors:

* ``cubic``: a cubic spring, and a free field of the displacement, of 10 functions;
* ``friction``: dry friction, and a free field of the hidden velocity, of 15 functions;
* ``coupling``: two oscillators joined by a linear spring have a cubic one between them as well, and
  the field is of both displacements, of 5 x 5 functions, with action and reaction.

``python -m benchmarks.missing_force_power CASE COUNT`` simulates so many records at each of four
strengths, the first of which is zero, and prints for each of them

* the median, lowest and highest log Bayes factor against no force of the model with the field, and
  of the one with the true form, whose coefficient is unknown; the shares above log 3 and log 20;
* the median of what the form has more than the field, and the largest standard error;
* twice the log of the likelihood ratio of the true form, median and share above 3.84;
* the share of the visited states, with its standard error over records, at which the 90 % band of
  `field` has the force, for friction where the velocity is above 2; everywhere; and at which
  the band of the field and the linear force together has their sum;
* how many records had which warnings.

The evidences are by importance sampling: given amplitude and length the posterior is nearly normal,
and a grid of both has the proposals. A record takes one to two CPU seconds. A third argument is the
first seed.

``python -m benchmarks.missing_force_power filters`` prints log-likelihoods of the strongest records
by `EKF`, `UKF` and `GuidedPF(2000)`, with no force, with the true form, and with the field that is
nearest to it. They differ by at most 0.05, but with the true form of the friction `EKF` is 0.3 too
low, and `UKF`, which serves there, 0.2 too high.
"""

import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from pytensor import function
from scipy.special import logsumexp
from scipy.stats import gamma, halfnorm, multivariate_t, norm

import pymc_statespace_filters as psf

DT, STEPS = 0.05, np.arange(1, 301, 2)
TIME = DT * np.arange(STEPS[-1] + 1)
PUSH = 2 * np.sin(0.7 * TIME) + 1.5 * np.sin(1.3 * TIME + 1)
PULL = 2 * np.sin(0.5 * TIME + 2) + 1.5 * np.sin(1.7 * TIME)
RECORD = {"steps": STEPS, "inputs": np.column_stack([PUSH, PULL])}
JOINT = 0.5  # the known stiffness between two oscillators
PRIORS = {"k": norm(1.0, 0.1), "c": norm(0.3, 0.05)}
JUMP = 0.05  # the width of the jump of the friction, in the unit of the velocity
N_POINTS = 4000
EKF = psf.EKF()
# Amplitudes, and lengths beyond the shortest, of equal probability under their priors.
CELLS = tuple(
    each.ravel()
    for each in np.meshgrid(
        halfnorm().ppf((np.arange(60) + 0.5) / 60),
        gamma(2, scale=0.5).ppf((np.arange(12) + 0.5) / 12),
    )
)


def one(x, u, k, c, force):
    """The drift of an oscillator."""
    z, v = x
    return [v, u[0] - k * z - c * v + force]


def two(x, u, k, c, force):
    """The drift of two that are joined."""
    z1, z2, v1, v2 = x
    force = force - JOINT * (z1 - z2)
    return [v1, v2, u[0] - k * z1 - c * v1 + force, u[1] - k * z2 - c * v2 - force]


class Case(NamedTuple):
    """A kind of missing force, its form for one unit of its coefficient, and the free field."""

    drift: Callable
    names: list[str]
    form: Callable
    strengths: tuple[float, ...]
    prior_sd: float  # of the coefficient: a force of about one unit, as under the field's prior
    basis: Any
    filter_of_form: Any  # EKF is off where the friction jumps
    away: Callable  # whether states are where a smooth field can follow
    replaced: str  # the parameter of which a linear part of the field can take the place


ONE, TWO = ["z", "v"], ["z1", "z2", "v1", "v2"]
TERMS = psf.mechanics.gaussian_process_terms
CASES = {
    "cubic": Case(
        one, ONE, lambda z, v: -(z**3), (0.0, 0.004, 0.01, 0.025), 0.025,
        TERMS("z", (-7.5, 7.5), 10), EKF, lambda z: z < np.inf, "k",
    ),
    "friction": Case(
        one, ONE, lambda z, v: -pt.tanh(v / JUMP), (0.0, 0.2, 0.4, 0.8), 1.0,
        TERMS("v", (-7, 7), 15), psf.UKF(), lambda v: abs(v) > 2.0, "c",
    ),
    "coupling": Case(
        two, TWO, lambda z1, z2, v1, v2: -((z1 - z2) ** 3), (0.0, 0.003, 0.006, 0.0125), 0.03,
        TERMS(["z1", "z2"], [(-4.5, 6), (-4.5, 6)], 5), EKF, lambda z1, z2: z1 < np.inf, "",
    ),
}  # fmt: skip


def systems(case: Case) -> dict[str, psf.StateSpaceModel]:
    """Without a force, with its true form, and with a free field."""
    where = [case.names.index(state) for state in case.basis.states]

    def none(x, u, k, c):
        return case.drift(x, u, k, c, 0.0)

    def form(x, u, k, c, g):
        return case.drift(x, u, k, c, g * case.form(*x))

    def field(x, u, k, c, f):
        return case.drift(x, u, k, c, f @ case.basis([x[i] for i in where]))

    return {
        each.__name__: system(each, case.names, {"f": (len(case.basis),)} if each is field else {})
        for each in (none, form, field)
    }


def system(drift: Callable, names: list[str], shapes: dict) -> psf.StateSpaceModel:
    """Oscillators, displacements before velocities, of which the displacements are measured."""
    n = len(names) // 2
    return psf.StateSpaceModel(
        transition=psf.SemiImplicitEuler(
            drift, np.vstack([np.zeros((n, n)), 0.2 * np.eye(n)]), dt=DT, velocities=names[n:]
        ),
        observation=lambda x: [x[i] for i in range(n)],
        observation_noise=0.1**2 * np.eye(n),
        initial_mean=np.zeros(2 * n),
        initial_cov=0.01 * np.eye(2 * n),
        states=names,
        inputs=["push", "pull"],
        shapes=shapes,
    )


def model_of_field(case: Case, which: psf.StateSpaceModel, observed: Any) -> pm.Model:
    """The model with the free field."""
    with pm.Model(coords={"term": case.basis.names}) as model:
        for name, law in PRIORS.items():
            pm.Normal(name, law.mean(), law.std())
        amplitude = pm.HalfNormal("amplitude", 1.0)
        length = case.basis.shortest_length.max() + pm.Gamma("longer", 2, 2)
        white = pm.Normal("white", dims="term")
        pm.Deterministic("f", case.basis.prior_sd(length, amplitude) * white, dims="term")
        psf.StateSpace("d", which, EKF, observed=observed, **RECORD)
    return model


class Points(NamedTuple):
    """Weighted points of a posterior: k, c and coefficients in a row, with amplitude and length."""

    values: np.ndarray
    log_weights: np.ndarray
    amplitude: np.ndarray
    longer: np.ndarray
    maximum: float  # of the log-likelihood, where what is known of k and c beforehand is data

    def log_evidence(self) -> float:
        """The logarithm of the mean weight."""
        return logsumexp(self.log_weights) - np.log(len(self.log_weights))

    def error(self) -> float:
        """The standard error of the logarithm."""
        weights = np.exp(self.log_weights - self.log_evidence())
        return weights.std() / np.sqrt(len(weights))

    def resampled(self, rng: Any, shape: tuple[int, int], sd_of_one: Callable) -> Any:
        """Draws for `field`."""
        share = np.exp(self.log_weights - logsumexp(self.log_weights))
        chosen = rng.choice(len(share), size=np.prod(shape), p=share)
        f = self.values[chosen, 2:]
        amplitude, longer = self.amplitude[chosen], self.longer[chosen]
        drawn = {
            "k": self.values[chosen, 0], "c": self.values[chosen, 1], "f": f,
            "amplitude": amplitude, "longer": longer, "white": f / sd_of_one(amplitude, longer),
        }  # fmt: skip
        return az.from_dict(
            {"posterior": {k: v.reshape(*shape, *v.shape[1:]) for k, v in drawn.items()}}
        )


def normal_at(log_likelihood: Callable, at: np.ndarray, step: np.ndarray) -> tuple:
    """Precision of a normal density like the likelihood at a point, and precision times mean."""
    i, j = np.triu_indices(len(at))
    e = np.diag(step)
    corners = [at + a * e[i] + b * e[j] for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1))]
    one, two, three, four = np.split(log_likelihood(np.concatenate(corners)), 4)
    scaled = np.zeros((len(at), len(at)))
    scaled[i, j] = scaled[j, i] = (three + four - one - two) / 4
    eigenvalues, axes = np.linalg.eigh(scaled)
    precision = (axes * np.maximum(eigenvalues, 0)) @ axes.T / np.outer(step, step)
    ends = log_likelihood(np.concatenate([at + e, at - e]))
    return precision, precision @ at + (ends[: len(at)] - ends[len(at) :]) / (2 * step)


def top(log_likelihood: Callable, at: np.ndarray, centre: np.ndarray, sd: np.ndarray) -> tuple:
    """The maximum of the posterior under one prior, and steps of half a standard deviation."""
    step = 0.2 * sd
    for _ in range(10):
        precision, shift = normal_at(log_likelihood, at, step)
        slope = shift - precision @ at - (at - centre) / sd**2
        # Newton's step and shorter ones: far from the maximum the likelihood is not like a normal.
        more = np.array([0.0, 1, 10, 100, 1e3, 1e4])[:, None, None]
        steps = np.linalg.solve(precision + (1 + more) * np.diag(sd**-2.0), slope[:, None])
        ways = np.concatenate([at[None], at + steps[..., 0]])
        at = ways[np.argmax(log_likelihood(ways) + norm(centre, sd).logpdf(ways).sum(axis=1))]
        step = 0.5 * np.sqrt(np.diag(np.linalg.inv(precision + np.diag(sd**-2.0))))
    return at, step


def points_of(
    log_likelihood: Callable, start: np.ndarray, prior_sd: np.ndarray, cells: tuple, rng: Any
) -> Points:
    """Sample k, c and coefficients, whose prior sd (cells, coefficients) is one of some.

    Given the prior sd the posterior is nearly normal, and its evidence nearly known.
    """
    sd = np.hstack([np.tile([0.1, 0.05], (len(prior_sd), 1)), prior_sd])
    n = sd.shape[1]
    centre = np.r_[1.0, 0.3, np.zeros(n - 2)]
    at, step = top(log_likelihood, start, centre, np.median(sd, axis=0))
    for _ in range(2):
        precision, shift = normal_at(log_likelihood, at, step)
        # In units of the prior: how far from its mean, and how much narrower.
        scaled = np.eye(n) + sd[:, :, None] * precision * sd[:, None]
        pull = sd * (shift - precision @ centre)
        mean = np.linalg.solve(scaled, pull[..., None])[..., 0]
        logs = 0.5 * (pull * mean).sum(axis=1) - 0.5 * np.linalg.slogdet(scaled)[1]
        share = np.exp(logs - logsumexp(logs))
        spread = sd * np.sqrt(np.diagonal(np.linalg.inv(scaled), axis1=1, axis2=2))
        at, step = centre + share @ (sd * mean), 0.5 * share @ spread
    share = 0.9 * share + 0.1 / len(share)
    cell = rng.choice(len(share), size=N_POINTS, p=share)
    root = np.linalg.cholesky(scaled)[cell]
    law = multivariate_t(np.zeros(n), df=20, seed=rng)
    z = law.rvs(N_POINTS).reshape(-1, n)
    unit = mean[cell] + np.linalg.solve(np.swapaxes(root, 1, 2), z[..., None])[..., 0]
    values = centre + sd[cell] * unit
    likelihood, prior = log_likelihood(values), norm.logpdf(unit)
    log_weights = likelihood + prior.sum(axis=1) - np.log(len(share) * share[cell]) - law.logpdf(z)
    log_weights -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    # The highest of so many points is not the maximum: from it on by Newton's steps.
    best = values[np.argmax(likelihood + prior[:, :2].sum(axis=1))]
    flat = np.eye(n) * np.r_[100.0, 400.0, np.zeros(n - 2)]
    maximum = -np.inf
    if n <= 3:
        for _ in range(4):
            precision, shift = normal_at(log_likelihood, best, 0.2 * step)
            best = np.linalg.solve(precision + flat, shift + flat @ centre)
            known = norm(centre[:2], sd[0, :2]).logpdf(best[:2]).sum()
            maximum = max(maximum, log_likelihood(best[None])[0] + known)
    return Points(values, log_weights, *(each[cell] for each in cells), maximum)


class Found(NamedTuple):
    """What one record says: log Bayes factors, with errors, the ratio, and the shares covered."""

    field: float
    form: float
    se: float
    ratio: float  # twice the log
    covered: float
    covered_everywhere: float
    covered_sum: float  # of the field and the linear force, by quantiles of the draws
    warned: set[str]


def one_record(case: Case, made: dict, strength: float, seed: int) -> Found:
    """Simulate a record, and look for the force in it."""
    rng = np.random.default_rng(seed)
    truth = {name: prior.rvs(random_state=rng) for name, prior in PRIORS.items()}
    truth["g"] = strength
    record = psf.simulate(made["form"], truth, random_seed=rng, **RECORD)
    observed = record["observations"].values

    def likelihood(kind, chosen=EKF):
        def log_likelihood(values):
            given = dict(zip(("k", "c"), values.T, strict=False))
            if kind == "form":
                given["g"] = values[:, 2]
            if kind == "field":
                given["f"] = values[:, 2:]
            terms = psf.log_likelihood(made[kind], chosen, given, observed, **RECORD)
            return terms.sum(axis=-1)

        return log_likelihood

    x, force, near = force_of(case, record, strength)
    start, one = np.array([truth["k"], truth["c"]]), np.zeros((2, 1))
    none = points_of(likelihood("none"), start, np.empty((1, 0)), one, rng)
    form = points_of(
        likelihood("form", case.filter_of_form), np.r_[start, strength],
        np.array([[case.prior_sd]]), one, rng,
    )  # fmt: skip
    sd = prior_sd_of(case.basis)
    field = points_of(likelihood("field"), np.r_[start, near], sd(*CELLS), CELLS, rng)
    draws = field.resampled(rng, (2, 500), sd)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = psf.field(
            draws, model_of_field(case, made["field"], observed),
            terms={"f": case.basis}, n_draws=4, random_seed=seed, progressbar=False,
        )["f"]  # fmt: skip
    at = {
        name: xr.DataArray(each, dims="row")
        for name, each in zip(case.basis.states, x, strict=True)
    }
    low, high = (found[end].to_dataset(name="f")["f"].interp(at).values for end in ("low", "high"))
    inside, away = (low < force) & (force < high), case.away(*x)
    sums, total = draws.posterior["f"].values.reshape(-1, len(near)) @ case.basis(x).eval(), force
    if case.replaced:
        sums = sums - np.outer(draws.posterior[case.replaced], x[0])
        total = force - truth[case.replaced] * x[0]
    low, high = np.quantile(sums, [0.05, 0.95], axis=0)
    both = (low < total) & (total < high)
    return Found(
        field.log_evidence() - none.log_evidence(),
        form.log_evidence() - none.log_evidence(),
        field.error(),
        2 * (form.maximum - none.maximum),
        inside[away].mean(),
        inside.mean(),
        both[away].mean(),
        {f"{type(each.message).__name__}: {str(each.message)[:60]}" for each in said},
    )


def force_of(case: Case, record: xr.Dataset, strength: float) -> tuple:
    """The states of the field at the rows, the force there, and the coefficients nearest to it."""
    states = record["states"].to_dataset("state")
    form = pt.as_tensor(case.form(*(states[name].values for name in case.names)))
    force = strength * form.eval()
    x = np.stack([states[name].values for name in case.basis.states])
    return x, force, np.linalg.lstsq(case.basis(x).eval().T, force, rcond=1e-3)[0]


def prior_sd_of(basis: Any) -> Callable:
    """The prior standard deviations (n, coefficients) at n amplitudes and lengths."""
    longer = pt.dscalar()
    given = function([longer], basis.prior_sd(basis.shortest_length.max() + longer, 1.0))

    def sd(amplitude, longer):
        values, which = np.unique(longer, return_inverse=True)
        return amplitude[:, None] * np.array([given(one) for one in values])[which]

    return sd


def filters(seed: int = 1) -> None:
    """Print log-likelihoods by filters."""
    for name, case in CASES.items():
        made = systems(case)
        truth = {"k": 1.0, "c": 0.3, "g": case.strengths[-1]}
        record = psf.simulate(made["form"], truth, random_seed=seed, **RECORD)
        _, _, near = force_of(case, record, truth["g"])
        for kind, given in (("none", {}), ("form", {"g": truth["g"]}), ("field", {"f": near})):
            given |= {"k": truth["k"], "c": truth["c"]}
            logs = [
                psf.log_likelihood(made[kind], one, given, record["observations"], **RECORD).sum()
                for one in (EKF, psf.UKF(), psf.GuidedPF(2000))
            ]
            print(name, kind, *(f"{one:.2f}" for one in logs))


def main(name: str, count: int, first: int = 1) -> None:
    """Print the table of a case."""
    case, began = CASES[name], time.process_time()
    made = systems(case)
    for strength in case.strengths:
        found = [one_record(case, made, strength, seed) for seed in range(first, first + count)]
        print(f"{name} {strength:g}")
        for kind in ("field", "form"):
            logs = np.array([getattr(one, kind) for one in found])
            three, twenty = ((logs > np.log(k)).mean() for k in (3, 20))
            print(
                f"  {kind}: log BF {np.median(logs):.1f} ({logs.min():.1f} to {logs.max():.1f}), "
                f"above 3 {three:.2f}, above 20 {twenty:.2f}"
            )
        less = np.median([one.form - one.field for one in found])
        print(f"  form less field {less:.1f}; largest se {max(one.se for one in found):.2f}")
        ratios = np.array([one.ratio for one in found])
        print(f"  2 log LR {np.median(ratios):.1f}, above 3.84 {(ratios > 3.84).mean():.2f}")
        for label in ("covered", "covered_everywhere", "covered_sum"):
            share = np.array([getattr(one, label) for one in found])
            print(f"  {label} {share.mean():.3f} ({share.std() / len(share) ** 0.5:.3f})")
        for said, times in Counter(each for one in found for each in one.warned).items():
            print(f"  {times} warned: {said}")
        sys.stdout.flush()
    seconds = (time.process_time() - began) / (count * len(case.strengths))
    print(f"CPU seconds of a record: {seconds:.1f}")


if __name__ == "__main__":
    if sys.argv[1] == "filters":
        filters()
    else:
        main(sys.argv[1], *map(int, sys.argv[2:]))
