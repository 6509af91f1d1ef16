"""Growth in two regimes: a Markov-switching autoregression beside that of statsmodels.

Quarterly growth of the real gross domestic product of the United States, 1959 to 2009, which
statsmodels ships (`macrodata`), as in J. D. Hamilton, "A new approach to the economic analysis of
nonstationary time series and the business cycle", Econometrica 57 (1989), of order one:

    y_t - mu_{s(t)} = phi (y_{t-1} - mu_{s(t-1)}) + e_t,    e_t ~ N(0, sigma^2).

Both condition on the first quarter, whose regime has the stationary distribution. Ours remembers
the regime of the quarter before, and has the last growth as an input.
"""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import statsmodels.api as sm
from comparison import Comparison, Study, cpu_seconds, table
from numpy.typing import NDArray

import pymc_statespace_filters as psf

GROWTH = 100 * np.diff(np.log(sm.datasets.macrodata.load_pandas().data.realgdp.to_numpy()))


def at(values, x):
    """The element or row that belongs to a regime."""
    return values[pt.cast(x, "int64")]


growth = psf.StateSpaceModel(
    transition=lambda x, q: [q[0], x[0]],
    process_dist=lambda x, P: [pm.Categorical.dist(at(P, x[0]))],
    observation=lambda x, u, mu, phi: [at(mu, x[0]) + phi * (u[0] - at(mu, x[1]))],
    observation_noise=lambda variance: [[variance]],
    initial_dist=lambda P: [pm.Categorical.dist(psf.system.stationary(P)), 0],
    states=["regime", "regime before"],
    observables=["growth"],
    inputs=["last growth"],
    shapes={"P": (2, 2), "mu": (2,)},
)


def log_likelihood(points: NDArray) -> NDArray:
    """Of points of statsmodels' parameters: p[0->0], p[1->0], means, variance, phi."""
    stays, back, first, second, variance, phi = points.T
    P = np.stack([stays, 1 - stays, back, 1 - back], axis=-1).reshape(-1, 2, 2)
    params = {"P": P, "mu": np.stack([first, second], axis=-1), "variance": variance, "phi": phi}
    return psf.log_likelihood(
        growth, psf.FiniteStateFilter(), params, GROWTH[1:, np.newaxis],
        steps=np.arange(1, GROWTH.size), inputs=np.append(GROWTH[0], GROWTH[:-1])[:, np.newaxis],
    ).sum(axis=-1)  # fmt: skip


def standard_errors(point: NDArray) -> NDArray:
    """From the curvature of the log-likelihood, by differences."""
    steps = 1e-4 * np.maximum(abs(point), 0.1)
    corners = [(a, b) for a in (1, -1) for b in (1, -1)]
    n, units = point.size, np.diag(steps)
    pairs = [(i, j) for i in range(n) for j in range(n)]
    points = [point + a * units[i] + b * units[j] for i, j in pairs for a, b in corners]
    signs = np.array([a * b for a, b in corners])
    differences = log_likelihood(np.array(points)).reshape(n, n, 4) @ signs
    return np.sqrt(np.diag(np.linalg.inv(-differences / (4 * np.outer(steps, steps)))))


def study() -> Study:
    theirs = sm.tsa.MarkovAutoregression(GROWTH, k_regimes=2, order=1, switching_ar=False)
    # Recessions are short; from its own start the search ends at a lower maximum.
    fit = theirs.fit(np.array([0.6, 0.05, -0.7, 0.9, 0.5, 0.2]), disp=False)
    with cpu_seconds() as seconds:
        value = log_likelihood(fit.params[np.newaxis])[0]
        errors = standard_errors(fit.params)
    comparisons = [
        Comparison("largest log-likelihood", fit.llf, 1e-6, value, by_chance=False),
        *(
            Comparison(f"standard error of {name}", theirs, 1e-3 * theirs, ours, by_chance=False)
            for name, theirs, ours in zip(fit.model.param_names, fit.bse, errors, strict=True)
        ),
    ]
    return Study(
        "growth in two regimes, 202 quarters",
        "statsmodels' MarkovAutoregression on its data set macrodata",
        comparisons,
        seconds[0],
        "At their maximum. Both condition on the first quarter, with a stationary regime. The "
        "errors allowed are 1e-6 of a nat and a thousandth of a standard error.",
    )


if __name__ == "__main__":
    print(table([study()]))
