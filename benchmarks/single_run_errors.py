"""Errors of the log-evidence from one run, against the spread of the populations of `sample_smc`.

Waste-free populations: the relative variances of the mean weights of all stages, from the means of
the chains (Dau and Chopin 2022, "Waste-free sequential Monte Carlo", J. R. Stat. Soc. B 84, Section
4). Populations with multinomial resampling and without waste-free moves: from the first ancestors
of the particles (Lee and Whiteley 2018, "Variance estimation in the particle filter", Biometrika
105, 609-625). The pilot has fixed the stages of all populations. The truth is the variance over 400
populations, each of which gives an estimate. Ten populations have the spread of theirs. Run it with
``python -m benchmarks.single_run_errors`` from the root of the repository.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import pymc_statespace_filters as psf
from benchmarks.smc import banana, funnel, wells
from pymc_statespace_filters.smc.moves import Size
from pymc_statespace_filters.smc.particles import Populations

POPULATIONS = 400  # 200 in the figures of the guide for the banana
Array = NDArray[np.float64]


class Recorded:
    """Weights and ancestors of all populations but the pilot, stage by stage."""

    def __init__(self) -> None:
        self.weights: list[Array] = []  # (R, N) of each stage, relative to their mean
        self.ancestors: list[NDArray[np.int64]] = []  # (R, N)

    @contextmanager
    def recording(self, multinomial: bool) -> Iterator[None]:
        """While `sample_smc` runs."""
        raised, resampled = Populations.raised, Populations.resampled

        def noted_raised(populations, step):
            new, log_mean = raised(populations, step)
            if len(log_mean) > 1:
                size = new.log_weights.shape[1]
                self.weights.append(np.exp(new.log_weights) * size)
            return new, log_mean

        def noted_resampled(populations, count, rng):
            n_populations, size = populations.log_weights.shape
            if n_populations == 1 or not multinomial:
                return resampled(populations, count, rng)
            weights = np.exp(populations.log_weights)
            index = np.stack([rng.choice(size, count, p=w / w.sum()) for w in weights])
            self.ancestors.append(index)
            places = index + size * np.arange(n_populations)[:, np.newaxis]
            return populations.particles.at(places.ravel())

        with patch.multiple(Populations, raised=noted_raised, resampled=noted_resampled):
            yield

    def from_chains(self, size: Size) -> Array:
        """Relative variances (R,) of the evidences, by the chains of each stage."""
        first, *others = self.weights
        total = first.var(axis=1, ddof=1) / first.shape[1]
        for weights in others:
            means = weights.reshape(len(weights), size.n_chains, size.length).mean(axis=2)
            total += means.var(axis=1, ddof=1) / size.n_chains
        return total

    def from_ancestors(self) -> Array:
        """Relative variances (R,) by the weights that share a first ancestor."""
        *_, last = self.weights
        n_populations, count = last.shape
        n_stages, found = len(self.weights), np.empty(n_populations)
        for r in range(n_populations):
            eves = np.arange(count)
            for index in self.ancestors[: n_stages - 1]:
                eves = eves[index[r]]
            shares = np.bincount(eves, last[r] / count, minlength=count)
            found[r] = 1 - (count / (count - 1)) ** n_stages * (1 - (shares**2).sum())
        return found


def compare(name: str, build, draws: int, waste_free: bool) -> None:
    """Print an estimator's mean and spread over the truth."""
    model, _ = build()
    recorded = Recorded()
    with recorded.recording(multinomial=not waste_free):
        idata = psf.sample_smc(
            draws, model=model, populations=POPULATIONS, waste_free=waste_free, random_seed=1,
            progressbar=False,
        )  # fmt: skip
    logs = idata["smc"]["log_evidence"].values
    relative = np.exp(logs - np.log(np.exp(logs - logs.max()).mean()) - logs.max())
    truth = relative.var(ddof=1)
    size = Size.of(draws, waste_free)
    found = recorded.from_chains(size) if waste_free else recorded.from_ancestors()
    tens = relative.reshape(-1, 10)
    spread = tens.var(axis=1, ddof=1) / tens.mean(axis=1) ** 2
    print(
        f"{name}, {draws} draws, {'chains' if waste_free else 'ancestors'}: sd {truth**0.5:.3f}; "
        f"estimate / truth {found.mean() / truth:.2f}, of one population +- "
        f"{found.std() / truth:.2f}, below a half {np.mean(found < truth / 2):.2f}; "
        f"of ten {spread.mean() / truth:.2f} +- {spread.std() / truth:.2f}",
        flush=True,
    )


def main() -> None:
    for name, build in {"wells": wells, "banana": banana, "funnel": funnel}.items():
        for waste_free in (True, False):
            for draws in (100, 400):
                compare(name, build, draws, waste_free)


if __name__ == "__main__":
    main()
