"""``suggest_particles``: the number of particles for a noisy likelihood, measured on the model."""

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
from pymc_statespace_filters.sampling.target.log_density import BoundLogDensity, LogDensity
from pymc_statespace_filters.sampling.target.target import Target
from pymc_statespace_filters.sampling.target.variables import (
    RaveledVariables,
    continuous_value_vars,
)
from pymc_statespace_filters.system.checks import check_random_seed

# Evaluations at a point: in a first estimate, at the centre, and at each point of the tail.
_FIRST, _CENTRE, _TAIL = 25, 100, 30
# Beyond this factor from the target the first estimate suffices.
_NEAR = 4.0
# The tail points among the pilot's draws: fractions of the draws of lower density.
_TAIL_FRACTIONS = (0.01, 0.02, 0.03, 0.04, 0.05)
# The best of the pilot's draws, compared by the mean of their estimates.
_N_BEST, _PER_BEST = 5, 12
# Particles of the pilot: least, most, and the most by which they are multiplied.
_PILOT_LEAST, _PILOT_MOST, _PILOT_GROWTH = 200, 1000, 16


def suggest_particles(
    model: Model,
    *,
    var_name: str | None = None,
    target: tuple[float, float] = TARGET,
    random_seed: int | np.random.Generator | None = None,
) -> pd.DataFrame:
    """Find the number of particles at which a chain gains most per unit of time.

    A short chain with fixed noise finds where the posterior lies. At its centre, and at five points
    of its tail, the likelihood is then estimated with many noise seeds, for larger and smaller
    numbers of particles than the model's own, until the variances of the log-likelihood at the
    centre bracket the target.

    Parameters
    ----------
    model : pymc.Model
        With a StateSpace variable whose filter is noisy, and continuous free variables.
    var_name : str, optional
        Name of the variable, required if several are noisy. The others keep their filters and
        their noise, which adds to the variance of the log-likelihood in a chain.
    target : (float, float), default (1.0, 3.3)
        Range for the variance of the estimated log-likelihood. Per unit of time chains gain most
        between 1 and 3.3 [1]_, [2]_.
    random_seed : None, int or numpy.random.Generator
        It determines the table except the column ``seconds``.

    Returns
    -------
    pandas.DataFrame
        A row for each number measured, indexed by ``n_particles``; the suggested number is in
        ``attrs["n_particles"]``. Its columns are

        ``variance_centre``, ``variance_low``, ``variance_high``
            variance of the estimated log-likelihood at the centre, and a 95 % interval for it
        ``variance_tail``
            largest of the tail points' variances, each from 30 seeds; NaN if the variance at the
            centre is so far from the target that the tail was not measured
        ``n_failed``
            evaluations that failed, which are not in the variances
        ``acceptance``
            lower bound for the fraction of an exact likelihood's accepted moves that a chain
            accepts with the noise at the centre: 2 Phi(-sqrt(variance / 2)), for Gaussian errors
        ``seconds``
            CPU time of one evaluation of the model
        ``suggested``
            whether this number is suggested

    Raises
    ------
    ModelError
        If an argument is not as described, the model has no noisy variable, or has several and
        ``var_name`` is not given, or a free variable is discrete.

    Warns
    -----
    FilterWarning
        If no number tried brings the variance into the target range, or if it is above 10 in the
        tail.

    Notes
    -----
    The centre is the best of the pilot's five highest draws, by 12 new estimates each; the tail
    points are the draws with density no lower than 1, 2, .., 5 % of all draws. The suggestion is
    the smallest number, of two digits, whose variance is within the target at the centre, with a
    margin for the error of measurement, and below 10 at the tail points; it is 10 if the variance
    is below the target even with 10 particles.

    The cost is 1000 to 1300 evaluations for the pilot, with 200 to 1000 particles, twice that if
    its own variance turns out to be above 10, and 250 for each of at most seven numbers. Numbers
    above 64 times the model's own, and above 16 000, are not tried.

    The number of particles changes the variance, and for EnKF and PFEnKF also the bias, which a
    small variance does not exclude.

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
    likelihood = _NoisyLikelihood(model, var_name, check_random_seed(random_seed))
    centre, tail = likelihood.points()

    def measure(n_particles: int) -> Row:
        spread, seconds = likelihood.timed_spread(n_particles, centre, _FIRST)
        if not low / _NEAR <= spread.variance <= high * _NEAR:
            return Row(n_particles, spread, np.nan, spread.n_failed, seconds)
        spread, seconds = likelihood.timed_spread(n_particles, centre, _CENTRE)
        spreads = [likelihood.spread(n_particles, point, _TAIL) for point in tail]
        n_failed = spread.n_failed + sum(s.n_failed for s in spreads)
        return Row(n_particles, spread, max(s.variance for s in spreads), n_failed, seconds)

    rows = search(measure, likelihood.filter.size(), (low, high))
    suggested, problem = choose(rows, (low, high))
    if problem is not None:
        warnings.warn(f"{likelihood.name}: {problem}", FilterWarning, stacklevel=2)
    return _table(rows, suggested)


class _NoisyLikelihood:
    """The log-density of a model for any number of particles of one noisy variable."""

    def __init__(self, model: Model, var_name: str | None, rng: np.random.Generator):
        self.name, self.filter = _noisy_variable(model, var_name)
        self._model, self._rng = model, rng
        self._seeds = noise_seeds(model)
        self._point = model.initial_point(random_seed=0)
        self._raveled = RaveledVariables(continuous_value_vars(None, model), self._point)
        if not self._raveled.dim:
            raise ModelError("model must have at least one free variable, it has none")
        self._densities: dict[int, BoundLogDensity] = {}

    def points(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Run the pilot; the centre of the posterior and its tail points, shape (d,) each."""
        n = min(max(self.filter.size(), _PILOT_LEAST), _PILOT_MOST)
        pilot = self._pilot(n, self._raveled.ravel(self._point))
        centre, variance = self._best(n, pilot)
        if variance > TOO_NOISY:  # the pilot's target was mostly noise
            n = round(n * min(variance, _PILOT_GROWTH))
            pilot = self._pilot(n, centre)
            centre, _ = self._best(n, pilot)
        tail = [int(np.argmin(np.abs(pilot.fractions - f))) for f in _TAIL_FRACTIONS]
        return centre, [pilot.positions[i] for i in dict.fromkeys(tail)]

    def spread(self, n_particles: int, position: np.ndarray, n_seeds: int) -> SeedSpread:
        """Seed spread at a point, with fixed noise of the other variables."""
        seeds = np.tile([int(s.get_value()) for s in self._seeds.values()], (n_seeds, 1))
        seeds[:, list(self._seeds).index(self.name)] = draw_seeds(self._rng, (n_seeds,))
        return seed_spread(self._density(n_particles), position, (), seeds)

    def timed_spread(
        self, n_particles: int, position: np.ndarray, n_seeds: int
    ) -> tuple[SeedSpread, float]:
        """Seed spread, and the CPU time of an evaluation in seconds."""
        self._density(n_particles)
        began = time.process_time()
        spread = self.spread(n_particles, position, n_seeds)
        return spread, (time.process_time() - began) / n_seeds

    def _density(self, n_particles: int) -> BoundLogDensity:
        if n_particles not in self._densities:
            variables, graph = self._raveled.variables, self._graph(n_particles)
            density = LogDensity(self._model, variables, self._point, self._seeds, graph=graph)
            self._densities[n_particles] = density.bind()
            self.spread(n_particles, self._raveled.ravel(self._point), 1)  # the first call compiles
        return self._densities[n_particles]

    def _graph(self, n_particles: int) -> TensorVariable:
        filters = {self.name: resized(self.filter, n_particles)}
        return with_filter([self._model.logp()], self._model, filters)[0]

    def _pilot(self, n_particles: int, start: np.ndarray) -> Pilot:
        target = Target(self._model, None, PILOT_SETTINGS, graph=self._graph(n_particles))
        return run_pilot(target, start, self._rng)

    def _best(self, n_particles: int, pilot: Pilot) -> tuple[np.ndarray, float]:
        """Compare the highest draws by new estimates, as those with fixed noise are too high."""
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
            "model must have a StateSpace variable with a noisy likelihood (EnKF, BootstrapPF, "
            "PFEnKF), got a model without one"
        )
    listed = ", ".join(map(repr, filters))
    if var_name is None and len(filters) > 1:
        raise ModelError(
            f"var_name must be one of {listed}, as several variables are noisy, got None"
        )
    name = next(iter(filters)) if var_name is None else var_name
    if name not in filters:
        raise ModelError(f"var_name must be a variable with a noisy filter, {listed}, got {name!r}")
    return name, filters[name]


def _checked_target(target: Any) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in target)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0.0 < low < high < np.inf:
        raise ModelError(f"target must be two positive numbers, the smaller first, got {target!r}")
    return low, high
