"""Whether half the observations, with a push, decide between two models as often as all without.

The system, rivals and designs are those of `docs/tutorials/which_experiment.md`. 100 records of
each design are simulated, half of them by either model, with parameters from the priors. Their
evidences are found by importance sampling of the `EKF` likelihood, with a Student-t law that is
fitted to the posterior, and a share of the prior. They are then corrected to the exact likelihood:
the mean of the ratio of `GridFilter` to `EKF` at draws of the posterior. Nothing is shared with
`expected_information`.

``python -m benchmarks.half_the_rows`` prints for each design: how many records have odds above 20
for the true model, and for the wrong one, by the exact likelihood and by the `EKF`; binomial
errors; and the standard error of the log odds, the median and the largest. A number makes that many
records. It takes a minute of CPU time. Of 100 records:

design | true above 20 (error) | wrong | by EKF: true | wrong | se: median | max
README | 6 of 100 (2.4) | 0 | 5 | 0 | 0.17 | 1.05
slow sine | 17 of 100 (3.8) | 1 | 20 | 0 | 0.24 | 1.20

`expected_information` says 0.08 and 0.25 with the 500 draws of the tutorial, 0.06 and 0.22 (errors
0.02 and 0.04) with 1000.
"""

import sys
import warnings
from itertools import product

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_t, norm

import pymc_statespace_filters as psf

DT, ODDS, N_RECORDS, N_CORRECTED, DEFENSIVE = 0.025, 20, 100, 20, 0.2
SYSTEM = psf.StateSpaceModel(
    psf.EulerMaruyama(
        lambda x, u, a, b, c: [a * x[0] - b * x[0] ** 3 - c * x[0] ** 5 + u[0]],
        lambda s: [[s]],
        dt=DT,
    ),
    observation=lambda x: [x[0]],
    observation_noise=[[0.05**2]],
    initial_mean=[1.0],
    initial_cov=[[0.01]],
    inputs=["force"],
)
MODELS = {"M2": 3, "M3": 4}  # the number of parameters a, log s / 0.8, b, c
WIDTHS = np.array([3.0, 0.1, 3.0, 3.0])


def design(last: float, force) -> dict:
    steps = np.arange(round(0.1 / DT), round(last / DT) + 1, round(0.1 / DT))
    return {"steps": steps, "inputs": 10 * force(DT * np.arange(steps[-1]))}


DESIGNS = {
    "README": design(10, np.zeros_like),
    "slow sine": design(5, lambda t: np.sin(np.pi * t / 2)),
}


def params(z: np.ndarray) -> dict[str, np.ndarray]:
    """Parameters of standard normal z (n, k); b and c have half-normal priors."""
    theta = np.zeros((len(z), 4))
    theta[:, : z.shape[1]] = z * WIDTHS[: z.shape[1]]
    a, log_s, b, c = theta.T
    return {"a": a, "s": 0.8 * np.exp(log_s), "b": abs(b), "c": abs(c)}


def log_likelihoods(filter, z: np.ndarray, observed: np.ndarray, design: dict) -> np.ndarray:
    """Of the record at z (n, k); -inf where the filter fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", psf.errors.FilterWarning)
        terms = psf.log_likelihood(SYSTEM, filter, params(z), observed, **design)
    return np.nan_to_num(terms.sum(axis=-1), nan=-np.inf, posinf=-np.inf)


def folded(law, z: np.ndarray) -> np.ndarray:
    """Log-density of z (n, k) whose signs of b and c, of no effect, are left out."""
    flips = np.array([[1, 1, *signs] for signs in product((1, -1), repeat=z.shape[1] - 2)])
    return logsumexp([law.logpdf(z * flip) for flip in flips], axis=0)


def log_evidence(k: int, observed: np.ndarray, design: dict, rng) -> np.ndarray:
    """By the exact likelihood, by the `EKF`, and the variance of the former."""

    def positive(z: np.ndarray) -> np.ndarray:
        return np.hstack([z[:, :2], abs(z[:, 2:])])

    z = positive(rng.normal(size=(6000, k)))
    prior = norm.logpdf(z).sum(axis=1) + (k - 2) * np.log(2)
    proposal, spread = prior, 2.0
    for n in (3000, 3000, 4000, None):
        log_weights = log_likelihoods(psf.EKF(), z, observed, design) + prior - proposal
        weights = np.exp(log_weights - logsumexp(log_weights))
        if n is None:
            break
        mean = weights @ z
        cov = (z - mean).T @ ((z - mean) * weights[:, None]) + 1e-4 * np.eye(k)
        law = multivariate_t(mean, spread * cov, df=5, seed=rng)
        is_prior = rng.random(n) < DEFENSIVE
        z = positive(np.where(is_prior[:, None], rng.normal(size=(n, k)), law.rvs(n)))
        prior = norm.logpdf(z).sum(axis=1) + (k - 2) * np.log(2)
        proposal = np.logaddexp(np.log(DEFENSIVE) + prior, np.log(1 - DEFENSIVE) + folded(law, z))
        spread = 1.2
    by_ekf = logsumexp(log_weights) - np.log(len(z))
    chosen = z[rng.choice(len(z), N_CORRECTED, p=weights)]
    ratio = log_likelihoods(psf.GridFilter(tolerance=1e-3), chosen, observed, design)
    ratio = ratio - log_likelihoods(psf.EKF(), chosen, observed, design)
    mean_ratio = logsumexp(ratio) - np.log(N_CORRECTED)
    variance = np.exp(ratio - mean_ratio).var() / N_CORRECTED + (weights**2).sum() - 1 / len(z)
    return np.array([by_ekf + mean_ratio, by_ekf, variance])


def main(n_records: int = N_RECORDS) -> None:
    print("design | true above 20 (error) | wrong | by EKF: true | wrong | se: median | max")
    for name, design in DESIGNS.items():
        found = []
        for r in range(n_records):
            rng = np.random.default_rng([r, 20])
            true, wrong = list(MODELS.values())[:: 1 if r % 2 else -1]
            truth = {key: value[0] for key, value in params(rng.normal(size=(1, true))).items()}
            made = psf.simulate(SYSTEM, truth, **design, random_seed=r)["observations"].values
            pair = [log_evidence(k, made, design, rng) for k in (true, wrong)]
            found.append([*(pair[0] - pair[1])[:2], np.sqrt(pair[0][2] + pair[1][2])])
        exact, by_ekf, se = np.array(found).T
        counts = [(odds > np.log(ODDS)).sum() for odds in (exact, -exact, by_ekf, -by_ekf)]
        share = counts[0] / n_records
        error = np.sqrt(share * (1 - share) / n_records)
        print(
            f"{name} | {counts[0]} of {n_records} ({n_records * error:.1f}) | {counts[1]} | "
            f"{counts[2]} | {counts[3]} | {np.median(se):.2f} | {se.max():.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
