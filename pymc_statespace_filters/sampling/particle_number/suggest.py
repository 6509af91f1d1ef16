"""How many particles a noisy likelihood needs: measured on the model itself."""

import time
import warnings
from typing import Any

import numpy as np
import pandas as pd
from pymc.model import Model
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.pymc_model.graph_rewrites import with_filter
from pymc_statespace_filters.pymc_model.inspection import noise_seeds, noisy_filters, resized
from pymc_statespace_filters.sampling.kernel.random_numbers import draw_seeds
from pymc_statespace_filters.sampling.output.likelihood_variance import (
    TARGET,
    TOO_NOISY,
    SeedSpread,
    acceptance_share,
    seed_spread,
)
from pymc_statespace_filters.sampling.particle_number.pilot_chain import SETTINGS as PILOT_SETTINGS
from pymc_statespace_filters.sampling.particle_number.pilot_chain import Pilot, run_pilot
from pymc_statespace_filters.sampling.particle_number.search import Row, choose, search
from pymc_statespace_filters.sampling.target.log_density import BoundDensity, LogDensity
from pymc_statespace_filters.sampling.target.target import Target
from pymc_statespace_filters.sampling.target.variables import HeldVariables, continuous_value_vars
from pymc_statespace_filters.system.checks import check_random_seed

# Evaluations at a point: a first look, the centre, and each point of the tail.
_GLANCE, _CENTRE, _TAIL = 25, 100, 30
# Beyond this factor from the target a first look is enough.
_NEAR = 4.0
# Where in the pilot's draws the tail points lie: shares of the draws of lower density.
_TAIL_SHARES = (0.01, 0.02, 0.03, 0.04, 0.05)
# The best of the pilot's draws, compared by the mean of their estimates.
_N_BEST, _PER_BEST = 5, 12
# Particles in the pilot: with very few its target is too rough, and it needs no more than some.
_PILOT_LEAST, _PILOT_MOST, _PILOT_GROWTH = 200, 1000, 16


def suggest_particles(
    model: Model,
    *,
    var_name: str | None = None,
    target: tuple[float, float] = TARGET,
    random_seed: int | np.random.Generator | None = None,
) -> pd.DataFrame:
    """Find how many particles bring the noise of the likelihood to where a chain works best.

    A short chain on held noise finds where the posterior lies. At its centre, and at five points of
    its tail, the likelihood is then estimated with many noise seeds, for numbers of particles up
    and down from the model's own until the variance of the log-likelihood at the centre brackets
    the target.

    Parameters
    ----------
    model : pymc.Model
        With a StateSpace variable whose filter is noisy, and continuous free variables.
    var_name : str, optional
        Which variable, where several are noisy. The others keep their filters and their noise:
        theirs adds to the variance that a chain meets.
    target : (float, float), default (1.0, 3.3)
        The variance of the estimated log-likelihood. Per unit of time chains gain most between 1
        and 3.3 [1]_, [2]_.
    random_seed : None, int or numpy.random.Generator
        The table is a function of it, but for the column ``seconds``.

    Returns
    -------
    pandas.DataFrame
        A row for each number measured, indexed by ``n_particles``; the number to take is in
        ``attrs["n_particles"]``. Its columns are

        ``variance_centre``, ``variance_low``, ``variance_high``
            variance of the estimated log-likelihood at the centre, and a 95 % interval for it
        ``variance_tail``
            the largest of the tail points' variances, each from 30 seeds; NaN where the centre is
            so far from the target that the tail was not measured
        ``n_failed``
            evaluations that failed and are not in the variances
        ``acceptance``
            share of an exact likelihood's moves that the noise at the centre lets through, at
            least: 2 Phi(-sqrt(variance / 2)), for Gaussian errors
        ``seconds``
            CPU time of one evaluation of the model
        ``suggested``
            whether this is the number to take

    Raises
    ------
    ModelError
        If an argument is not as described, the model has no noisy variable or more than one and
        none is named, or a free variable is discrete.

    Warns
    -----
    FilterWarning
        If no number that was tried brings the variance into the target, or if it is above 10 in the
        tail.

    Notes
    -----
    The centre is the best of the pilot's five highest draws, by 12 new estimates each; tail points
    are the draws with 1, 2, .., 5 % of the draws no higher. The suggestion is the smallest
    number, in two digits, whose variance at the centre lies in the target with room for the
    error of measurement, and at the tail points below 10; if even 10 particles have too
    little noise, it is 10.

    The cost is 1000 to 1300 evaluations for the pilot, with 200 to 1000 particles, twice that where
    its own noise turns out to be above 10, and 250 for each of at most seven numbers. Numbers above
    64 times the model's own, and above 16 000, are not tried.

    The number of particles changes the noise, and for EnKF and PFEnKF also the bias, which a small
    variance says nothing about.

    References
    ----------
    .. [1] A. Doucet, M. K. Pitt, G. Deligiannidis and R. Kohn (2015). Efficient implementation of
       Markov chain Monte Carlo when using an unbiased likelihood estimator. Biometrika 102,
       295-313.
    .. [2] C. Sherlock, A. H. Thiery, G. O. Roberts and J. S. Rosenthal (2015). On the efficiency of
       pseudo-marginal random walk Metropolis algorithms. Annals of Statistics 43, 238-275.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> record = psf.simulate(system, {"a": 0.8}, steps=range(1, 41), random_seed=1)
    >>> with pm.Model() as model:
    ...     a = pm.Normal("a", 0, 1)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.BootstrapPF(200), steps=range(1, 41),
    ...         observed=record["observations"],
    ...     )
    >>> table = psf.suggest_particles(model, random_seed=1)
    >>> bool(1.0 < table.loc[table.attrs["n_particles"], "variance_centre"] < 3.3)
    True
    """
    low, high = _checked_target(target)
    bench = _Bench(model, var_name, check_random_seed(random_seed))
    centre, tail = bench.points()

    def measure(n_particles: int) -> Row:
        spread, seconds = bench.timed_spread(n_particles, centre, _GLANCE)
        if not low / _NEAR <= spread.variance <= high * _NEAR:
            return Row(n_particles, spread, np.nan, spread.n_failed, seconds)
        spread, seconds = bench.timed_spread(n_particles, centre, _CENTRE)
        spreads = [bench.spread(n_particles, point, _TAIL) for point in tail]
        n_failed = spread.n_failed + sum(s.n_failed for s in spreads)
        return Row(n_particles, spread, max(s.variance for s in spreads), n_failed, seconds)

    rows = search(measure, bench.filter.size(), (low, high))
    suggested, reading = choose(rows, (low, high))
    if reading is not None:
        warnings.warn(f"{bench.name}: {reading}", FilterWarning, stacklevel=2)
    return _table(rows, suggested)


class _Bench:
    """One noisy variable of a model, and the model's log-density for any number of its particles.

    Attributes
    ----------
    name : str
    filter : filter
        As the model has it.
    """

    def __init__(self, model: Model, var_name: str | None, rng: np.random.Generator):
        self.name, self.filter = _noisy_variable(model, var_name)
        self._model, self._rng = model, rng
        self._seeds = noise_seeds(model)
        self._point = model.initial_point(random_seed=0)
        self._held = HeldVariables(continuous_value_vars(None, model), self._point)
        if not self._held.dim:
            raise ModelError("model must have at least one free variable, it has none")
        self._densities: dict[int, BoundDensity] = {}

    def points(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Run the pilot and give the posterior's centre and its tail points, shape (d,) each."""
        n = min(max(self.filter.size(), _PILOT_LEAST), _PILOT_MOST)
        pilot = self._pilot(n, self._held.join(self._point))
        centre, variance = self._best(n, pilot)
        if variance > TOO_NOISY:  # the pilot saw noise more than the posterior
            n = round(n * min(variance, _PILOT_GROWTH))
            pilot = self._pilot(n, centre)
            centre, _ = self._best(n, pilot)
        tail = [int(np.argmin(np.abs(pilot.shares - share))) for share in _TAIL_SHARES]
        return centre, [pilot.positions[i] for i in dict.fromkeys(tail)]

    def spread(self, n_particles: int, position: np.ndarray, n_seeds: int) -> SeedSpread:
        """Seed spread at a point; the noise of other variables is held."""
        seeds = np.tile([int(s.get_value()) for s in self._seeds.values()], (n_seeds, 1))
        seeds[:, list(self._seeds).index(self.name)] = draw_seeds(self._rng, (n_seeds,))
        return seed_spread(self._density(n_particles), position, (), seeds)

    def timed_spread(
        self, n_particles: int, position: np.ndarray, n_seeds: int
    ) -> tuple[SeedSpread, float]:
        """Seed spread, and the CPU seconds of an evaluation."""
        self._density(n_particles)
        begun = time.process_time()
        spread = self.spread(n_particles, position, n_seeds)
        return spread, (time.process_time() - begun) / n_seeds

    def _density(self, n_particles: int) -> BoundDensity:
        if n_particles not in self._densities:
            variables, graph = self._held.variables, self._graph(n_particles)
            density = LogDensity(self._model, variables, self._point, self._seeds, graph=graph)
            self._densities[n_particles] = density.bind()
            self.spread(n_particles, self._held.join(self._point), 1)  # the first call compiles
        return self._densities[n_particles]

    def _graph(self, n_particles: int) -> TensorVariable:
        filters = {self.name: resized(self.filter, n_particles)}
        return with_filter([self._model.logp()], self._model, filters)[0]

    def _pilot(self, n_particles: int, start: np.ndarray) -> Pilot:
        target = Target(self._model, None, PILOT_SETTINGS, graph=self._graph(n_particles))
        return run_pilot(target, start, self._rng)

    def _best(self, n_particles: int, pilot: Pilot) -> tuple[np.ndarray, float]:
        """Compare the highest draws anew: held noise favours the points where it came out high."""
        spreads = [self.spread(n_particles, x, _PER_BEST) for x in pilot.positions[:_N_BEST]]
        best = int(np.argmax([spread.mean for spread in spreads]))
        return pilot.positions[best], spreads[best].variance


def _table(rows: list[Row], suggested: Row) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "n_particles": [row.n_particles for row in rows],
            "variance_centre": [row.centre.variance for row in rows],
            "variance_low": [row.centre.variance_low for row in rows],
            "variance_high": [row.centre.variance_high for row in rows],
            "variance_tail": [row.tail for row in rows],
            "n_failed": [row.n_failed for row in rows],
            "acceptance": [acceptance_share(row.centre.variance) for row in rows],
            "seconds": [row.seconds for row in rows],
            "suggested": [row is suggested for row in rows],
        }
    ).set_index("n_particles")
    table.attrs["n_particles"] = suggested.n_particles
    return table


def _noisy_variable(model: Any, var_name: Any) -> tuple[str, Any]:
    """Give the variable to tune, and its filter."""
    if not isinstance(model, Model):
        raise ModelError(f"model must be a pymc.Model, got {model!r}")
    filters = noisy_filters(model)
    if not filters:
        raise ModelError(
            "model has no StateSpace variable with a noisy likelihood (EnKF, BootstrapPF, "
            "PFEnKF): there is no number of particles to tune"
        )
    listed = ", ".join(map(repr, filters))
    if var_name is None and len(filters) > 1:
        raise ModelError(f"several variables are noisy, give var_name, one of {listed}")
    name = next(iter(filters)) if var_name is None else var_name
    if name not in filters:
        raise ModelError(f"var_name={name!r}: expected a variable with a noisy filter, {listed}")
    return name, filters[name]


def _checked_target(target: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in target)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0.0 < low < high < np.inf:
        raise ModelError(f"target={target!r}: expected two positive numbers, the smaller first")
    return low, high
