"""Whether the evidence that a force is missing, and the field found for it, are calibrated.

A relaxation with known noise is seen exactly, and its model has a force of unknown form beside it:
a sum of sines with the prior of a Gaussian process, non-centred, its amplitude half-normal. Nothing
is missing in half of the records; in the others amplitude and force are drawn from the prior. The
increments are linear in the coefficients, so that their posterior is normal for each amplitude, and
draws and Bayes factors are exact up to a quadrature over it. `select_terms` computes the factor
from these draws, and `field` the force.

``python -m benchmarks.missing_force 60`` prints, of 60 records: the errors of the log Bayes factors
over their standard errors, mean (0) and root mean square (1), and the largest error; z of
sum(truth - probability); of probabilities in five bins the mean, the frequency of a force and the
number, with the p value of all bins; of the records in which nothing is missing, how many factors
are above 3 and 10, at most a third and a tenth; and of the others the share of the visited states
at which the 90 % band has the force. A record takes about 4 CPU s. A second number is the first
seed.
"""

import sys
import warnings
from typing import NamedTuple

import arviz as az
import numpy as np
import pymc as pm
from scipy.special import expit, logsumexp
from scipy.stats import chi2

import pymc_statespace_filters as psf

N_ROWS, DT, NOISE = 300, 0.1, 0.5
N_BINS = 5  # of probabilities
LENGTH, WIDTH = 1.0, 1.0  # of the kernel, and of the prior of the amplitude
BASIS = psf.mechanics.gaussian_process_terms("z", (-2.5, 2.5), 10)
SD = BASIS.prior_sd(LENGTH, 1.0).eval()
SYSTEM = psf.StateSpaceModel(
    states=["z"],
    transition=lambda x, q, c: [x[0] + DT * (c @ BASIS(x) - x[0]) + NOISE * DT**0.5 * q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[1e-10]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
    shapes={"c": (len(BASIS),)},
)


class Found(NamedTuple):
    """Whether a force is missing, log Bayes factors, and the share of states covered."""

    missing: bool
    reported: float
    se: float
    exact: float
    covered: float
    doubtful: bool


def values(z):
    """The sines (terms, n) at states (n,)."""
    return BASIS(np.asarray(z)[None]).eval()


class Posterior:
    """The exact posterior of amplitude and coefficients, up to a quadrature over the amplitude."""

    def __init__(self, record):
        design = DT * values(record[:-1]).T * SD
        residual = np.diff(record) + DT * record[:-1]
        eigenvalues, self.axes = np.linalg.eigh(design.T @ design / (NOISE**2 * DT))
        self.precision = np.maximum(eigenvalues, 0)
        self.score = self.axes.T @ design.T @ residual / (NOISE**2 * DT)
        self.amplitudes = WIDTH * (np.arange(12000) + 0.5) / 2000
        square = self.amplitudes[:, None] ** 2
        log_factor = 0.5 * (
            square * self.score**2 / (1 + square * self.precision)
            - np.log1p(square * self.precision)
        ).sum(axis=1)
        log_prior = -0.5 * (self.amplitudes / WIDTH) ** 2
        self.log_weights = log_prior + log_factor
        self.log_bayes_factor = logsumexp(self.log_weights) - logsumexp(log_prior)

    def draws(self, rng, shape=(4, 1000)):
        """Independent draws of amplitude, standard coefficients and coefficients."""
        weights = np.exp(self.log_weights - logsumexp(self.log_weights))
        amplitude = rng.choice(self.amplitudes, size=np.prod(shape), p=weights)[:, None]
        precision = 1 + amplitude**2 * self.precision
        normal = rng.normal(size=precision.shape)
        z = (amplitude * self.score / precision + normal / np.sqrt(precision)) @ self.axes.T
        drawn = {"amplitude": amplitude[:, 0], "z": z, "c": amplitude * SD * z}
        return az.from_dict(
            {"posterior": {k: v.reshape(*shape, *v.shape[1:]) for k, v in drawn.items()}}
        )


def one_record(seed: int) -> Found:
    """Simulate a record, and let the package say whether a force is missing, and which."""
    rng = np.random.default_rng(seed)
    missing = bool(rng.random() < 0.5)
    truth = missing * abs(rng.normal(0, WIDTH)) * SD * rng.normal(size=len(SD))
    record = psf.simulate(SYSTEM, {"c": truth}, steps=range(N_ROWS), random_seed=rng)
    observed = record["observations"].values.ravel()
    with pm.Model() as model:
        amplitude = pm.HalfNormal("amplitude", WIDTH)
        z = pm.Normal("z", shape=len(BASIS))
        pm.Deterministic("c", BASIS.prior_sd(LENGTH, amplitude) * z)
        psf.StateSpace("d", SYSTEM, psf.EKF(), steps=range(N_ROWS), observed=observed)
    posterior = Posterior(observed)
    idata = posterior.draws(rng)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = psf.select_terms(
            model, {("amplitude", "z"): (0.0, 0.0)}, idata=idata,
            inclusion=0.5, random_seed=rng, progressbar=False,
        )["models"].to_dataset()  # fmt: skip
    doubtful = bool(said)
    found = found.sortby(found["present"].sum("term"))
    reported = float(found["log_evidence"].diff("model").item())
    covered = np.nan
    if missing:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # where the field is its prior
            band = psf.field(idata, model, terms={"c": BASIS}, n_draws=4, progressbar=False)["c"]
        inside = observed[(abs(observed) < 2.5)]
        low, high = (
            band[end].to_dataset(name="f")["f"].interp(z=inside) for end in ("low", "high")
        )
        covered = float(((low < (field := truth @ values(inside))) & (field < high)).mean())
    se = float(np.sqrt((found["se"] ** 2).sum()))
    return Found(missing, reported, se, posterior.log_bayes_factor, covered, doubtful)


def main(count: int, first: int = 1) -> None:
    """Print the calibration over so many records."""
    found = [one_record(seed) for seed in range(first, first + count)]
    error = np.array([one.reported - one.exact for one in found])
    scaled = error / [one.se for one in found]
    doubtful = np.array([one.doubtful for one in found])
    sure = ~doubtful
    print(
        f"error / se: mean {scaled[sure].mean():.2f}, rms {np.sqrt((scaled[sure] ** 2).mean()):.2f}"
    )
    print(f"largest error {abs(error[sure]).max():.2f} nats; {doubtful.sum()} of {count} doubtful")
    print_calibration(found)


def print_calibration(found) -> None:
    """Print whether probabilities of a missing force, and bands of it, are calibrated."""
    missing, reported, covered = (
        np.array([getattr(one, name) for one in found])
        for name in ("missing", "reported", "covered")
    )
    probability = expit(reported)
    variance = probability * (1 - probability)
    z = (missing - probability).sum() / np.sqrt(variance.sum())
    print(f"z of sum(truth - probability): {z:.1f}")
    chi_square, bins = 0.0, np.minimum((N_BINS * probability).astype(int), N_BINS - 1)
    for one in np.unique(bins):
        within = bins == one
        mean, frequency = probability[within].mean(), missing[within].mean()
        print(f"  probability {mean:.2f}, frequency {frequency:.2f} of {within.sum()}")
        chi_square += (missing - probability)[within].sum() ** 2 / variance[within].sum()
    print(f"p of these frequencies: {chi2.sf(chi_square, len(np.unique(bins))):.2f}")
    for k in (3, 10):
        above = reported > np.log(k)
        print(f"nothing missing: {above[~missing].sum()} of {(~missing).sum()} factors above {k}")
    print(f"a force: {(reported[missing] > np.log(3)).sum()} of {missing.sum()} factors above 3")
    covered = covered[missing]
    se = covered.std() / np.sqrt(len(covered))
    print(f"90 % bands at visited states: {covered.mean():.3f} ({se:.3f})")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
