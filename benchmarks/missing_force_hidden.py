"""Whether a missing force is found with the right probability if states are hidden.

As in ``docs/howto/missing_force.md``: chains of two models, one of them with a force of unknown
form; their evidences; and the force with its band. All unknowns of a record are drawn from their
priors, and in half of the records no force is missing. The systems are maps, the steps of a
stochastic differential equation, so that the filter alone approximates:

* ``oscillator``: the displacement is measured, the velocity is hidden; stiffness, damping, and
  amplitude and length of the force are unknown. `EKF`.
* ``double_well``: the state is measured with noise; its own noise and the amplitude of the force
  are unknown. `UKF`.

``python -m benchmarks.missing_force_hidden CASE 50`` prints a line for each record: whether a force
is missing, the log Bayes factor for one with its error, for every fifth record the same by
`select_terms` from the chains with the force, the share of the measured states at which the 90 %
band has the force, and CPU seconds. Then, of all records: z of sum(truth - probability); of
probabilities in five bins the mean, the frequency of a force and the number, with the chi-square
test of all bins; how many Bayes factors are above 3 and 10; the coverage of the bands; the ranks of
the force at one state among its draws, in five bins; the differences of the two routes over their
errors; in how many records draws diverge, and how many results are doubted; and of the double well
by how much `GridFilter`, which is exact, would change the log Bayes factors of the first three
records. A record takes 10 to 20 CPU s. Another number is the first seed.
"""

import logging
import sys
import time
import warnings
from typing import ClassVar, NamedTuple

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from scipy.special import logsumexp
from scipy.stats import chisquare

import pymc_statespace_filters as psf

from .missing_force import print_calibration

NUTS = {"draws": 500, "tune": 400, "chains": 2, "cores": 1, "until_ess": 150, "sampler": "nuts"}
N_TERMS = 8
EVERY = 5  # records of which one is also given to `select_terms`
N_BINS = 5
N_EXACT, N_DRAWS = 3, 20  # records compared with `GridFilter`, and draws of each


class Oscillator:
    """Of a mass on a spring with a damper the displacement is measured, the velocity is hidden."""

    state, at = "z", 1.0  # of which the force is a function, and the value at which ranks are taken
    basis = psf.mechanics.gaussian_process_terms("z", (-3, 3), N_TERMS)
    width, length = 0.5, None  # of the prior of the amplitude; the length of the force is unknown
    filter = psf.EKF()
    times = 0.05 * np.arange(301)
    rows: ClassVar = {
        "steps": np.arange(1, 301, 2),
        "inputs": np.sin(0.7 * times) + 0.75 * np.sin(1.3 * times + 1),
    }

    @staticmethod
    def system(missing=None, **settings):
        def step(x, q, u, k, c, force):
            z, v = x
            v = v + 0.05 * (u[0] - k * z - c * v + force) + 0.2 * 0.05**0.5 * q[0]
            return [z + 0.05 * v, v]

        def known(x, q, u, k, c):
            return step(x, q, u, k, c, 0.0)

        def free(x, q, u, k, c, f):
            return step(x, q, u, k, c, f @ missing(x[0]))

        return psf.StateSpaceModel(
            transition=free if missing else known,
            process_noise=[[1.0]],
            observation=lambda x: [x[0]],
            observation_noise=[[0.1**2]],
            initial_mean=[0.0, 0.0],
            initial_cov=0.01 * np.eye(2),
            states=["z", "v"],
            inputs=["force"],
            **settings,
        )

    @staticmethod
    def priors():
        pm.Normal("k", 1.0, 0.1)
        pm.LogNormal("c", np.log(0.3), 0.3)

    @staticmethod
    def drawn(rng):
        return {"k": rng.normal(1.0, 0.1), "c": 0.3 * np.exp(0.3 * rng.normal())}


class DoubleWell:
    """The state of a double well is measured with noise, and its own noise is unknown."""

    state, at = "x", 0.8
    basis = psf.mechanics.gaussian_process_terms("x", (-2, 2), N_TERMS)
    width, length = 1.0, 0.8
    filter = psf.UKF()
    rows: ClassVar = {"steps": np.arange(1, 301)}

    @staticmethod
    def system(missing=None, **settings):
        def step(x, q, s, force):
            return [x[0] + 0.1 * (x[0] - x[0] ** 3 + force) + s * 0.1**0.5 * q[0]]

        def known(x, q, s):
            return step(x, q, s, 0.0)

        def free(x, q, s, f):
            return step(x, q, s, f @ missing(x[0]))

        return psf.StateSpaceModel(
            transition=free if missing else known,
            process_noise=[[1.0]],
            observation=lambda x: [x[0]],
            observation_noise=[[0.07**2]],
            initial_mean=[1.0],
            initial_cov=[[0.1]],
            states=["x"],
            **settings,
        )

    @staticmethod
    def priors():
        pm.LogNormal("s", np.log(0.5), 0.2)

    @staticmethod
    def drawn(rng):
        return {"s": 0.5 * np.exp(0.2 * rng.normal())}


CASES = {"oscillator": Oscillator, "double_well": DoubleWell}


class Found(NamedTuple):
    """A record: log Bayes factors for a force by two routes, and how its band covers it."""

    missing: bool
    reported: float
    se: float
    selected: float  # by `select_terms`; NaN if it was not asked, as is ``selected_se``
    selected_se: float
    covered: float  # share of the measured states; NaN if no force is missing
    rank: float  # share of the draws below the force at one state
    diverging: int
    doubted: tuple[str, ...]
    shift: float  # of the log Bayes factor by the exact filter
    seconds: float


class Study:
    """Two models of one case, compiled once, and the record that they share."""

    def __init__(self, case):
        self.case = case
        self.record = pytensor.shared(np.zeros((len(case.rows["steps"]), 1)), name="record")
        self.systems = {
            "without": case.system(),
            "with": case.system(case.basis, shapes={"f": (N_TERMS,)}),
        }
        with pm.Model() as without:
            case.priors()
            self.observe(self.systems["without"])
        with pm.Model() as free:
            case.priors()
            amplitude = pm.HalfNormal("amplitude", case.width)
            self.absent = {("amplitude", "white"): (0.0, 0.0)}
            length = case.length
            if length is None:
                length = case.basis.shortest_length[0] + pm.Gamma("longer", 2, 2)
                self.absent = {("amplitude", "white", "longer"): (0.0, 0.0, 1.0)}
            white = pm.Normal("white", shape=N_TERMS)
            pm.Deterministic("f", case.basis.prior_sd(length, amplitude) * white)
            self.observe(self.systems["with"])
        self.models = {"without": without, "with": free}
        states, length, amplitude = pt.dvector(), pt.dscalar(), pt.dscalar()
        self.values = pytensor.function([states], case.basis(states[None]))
        self.sd = pytensor.function([length, amplitude], case.basis.prior_sd(length, amplitude))

    def observe(self, system):
        psf.StateSpace("d", system, self.case.filter, observed=self.record, **self.case.rows)

    def simulated(self, rng):
        """Whether a force is missing, its coefficients, and the record."""
        case, missing = self.case, bool(rng.random() < 0.5)
        truth = case.drawn(rng)
        amplitude = abs(rng.normal(0, case.width))
        longer = rng.gamma(2, 0.5)
        length = case.length or case.basis.shortest_length[0] + longer
        f = missing * self.sd(length, amplitude) * rng.normal(size=N_TERMS)
        made = psf.simulate(self.systems["with"], truth | {"f": f}, random_seed=rng, **case.rows)
        return missing, f, made["observations"].values

    def one(self, seed, select=False, exact=False):
        rng = np.random.default_rng(seed)
        missing, f, observed = self.simulated(rng)
        self.record.set_value(observed)
        quiet = {"random_seed": seed, "progressbar": False}
        began, doubted, trees = time.process_time(), [], {}

        def noted(function, *args, **kwargs):
            """Called with its doubts, which are warnings."""
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                result = function(*args, **kwargs, **quiet)
            if said:
                doubted.append(function.__name__)
            return result

        for name, model in self.models.items():
            trees[name] = noted(psf.sample, model=model, **NUTS)
            noted(psf.estimate_evidence, trees[name], model)
        table = psf.compare_evidence(trees)
        reported = table["log_evidence"]["with"] - table["log_evidence"]["without"]
        draws = trees["with"]
        band = noted(psf.field, draws, self.models["with"], terms={"f": self.case.basis}, n_draws=4)
        seconds, selected = time.process_time() - began, (np.nan, np.nan)
        if select:
            selected = self.by_terms(noted, draws)
        [at] = self.values([self.case.at]).T
        return Found(
            missing,
            float(reported),
            float(np.hypot(*table["se"])),
            *selected,
            self.covered(band["f"], f, observed) if missing else np.nan,
            float((draws["posterior"]["f"].values @ at < f @ at).mean()),
            int(draws["sample_stats"]["diverging"].sum()),
            tuple(doubted),
            self.shift(trees, observed, rng) if exact else np.nan,
            seconds,
        )

    def by_terms(self, noted, draws):
        """The log Bayes factor and its error, from draws of the model with a force."""
        model = self.models["with"]
        found = noted(psf.select_terms, model, self.absent, idata=draws, inclusion=0.5)["models"]
        found = found.to_dataset().sortby(found["present"].sum("term"))
        factor, se = found["log_evidence"].diff("model").item(), np.hypot(*found["se"].values)
        return float(factor), float(se)

    def covered(self, band, f, observed):
        """The share of the measured states in the box at which the band has the force."""
        [(lowest, highest)] = self.case.basis.box
        inside = observed[(observed > lowest) & (observed < highest)]
        low, high = (
            band[end].to_dataset(name="f")["f"].interp({self.case.state: inside}).values
            for end in ("low", "high")
        )
        truth = f @ self.values(inside)
        return float(((low < truth) & (truth < high)).mean())

    def shift(self, trees, observed, rng):
        """How much the log Bayes factor would move with `GridFilter`."""
        moved = {}
        for name, tree in trees.items():
            draws = tree["posterior"].to_dataset().stack(draw_=("chain", "draw"))
            draws = draws.isel(draw_=rng.integers(draws.sizes["draw_"], size=N_DRAWS))
            given = {key: draws[key].values.T for key in ("s", "f") if key in draws}
            exact, near = (
                psf.log_likelihood(self.systems[name], each, given, observed, **self.case.rows)
                for each in (psf.GridFilter(), self.case.filter)
            )
            moved[name] = logsumexp((exact - near).sum(axis=-1)) - np.log(N_DRAWS)
        return float(moved["with"] - moved["without"])


def main(name, count, first=1):
    """Print the calibration over so many records."""
    logging.getLogger("pymc").setLevel(logging.ERROR)
    study, found = Study(CASES[name]), []
    for i in range(count):
        exact = name == "double_well" and i < N_EXACT
        found.append(one := study.one(first + i, select=i % EVERY == EVERY - 1, exact=exact))
        print(
            f"{first + i} {'force' if one.missing else '-':5} {one.reported:6.2f} ({one.se:.2f}) "
            f"{one.selected:6.2f} ({one.selected_se:.2f}) {one.covered:.2f} {one.seconds:.0f} s",
            *one.doubted,
            flush=True,
        )
    summary(found)


def summary(found):
    """Print what records say together."""
    print_calibration(found)
    missing, reported, se, selected, selected_se, _, rank, diverging, doubted, shift, seconds = map(
        np.array, zip(*(one._replace(doubted=len(one.doubted)) for one in found), strict=True)
    )
    ranks = np.histogram(rank[missing], N_BINS, (0, 1))[0]
    print(f"ranks of the force {ranks}, p {chisquare(ranks).pvalue:.2f}")
    both = np.isfinite(selected_se)  # of sub-models that the data exclude it is unknown
    z = ((selected - reported) / np.hypot(se, selected_se))[both]
    print(f"two routes: difference / error has the rms {(z**2).mean() ** 0.5:.2f} of {z.size}")
    print(f"errors {np.median(se):.3f} and {np.nanmedian(selected_se):.3f} nats, medians")
    print(f"{(diverging > 0).sum()} with draws that diverge; {(doubted > 0).sum()} with doubts")
    if np.isfinite(shift).any():
        print("exact filter:", shift[np.isfinite(shift)].round(3))
    print(f"{seconds.mean():.1f} CPU s a record")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
