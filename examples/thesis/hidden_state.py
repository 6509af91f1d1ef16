"""What does one measurement say about a hidden state? Four filters and the exact answer.

A parameter alpha is known with an error, it determines a state x with another, and one measurement
d is made of x (section 4.5 of the thesis):

    alpha ~ N(0.8, 0.5),   x = g(alpha) + q,  q ~ N(0, 2),   d = h(x) + e,  e ~ N(0, 0.1)

g and h are each the identity (I) or the cosine (II), which gives four cases. Parameter and state
together are the state of a filter (Eq. 4.46), so one update by d = -0.5 estimates both. The exact
posterior, Eq. 4.48, is summed on a grid, and the filters are compared with it: in figures (Figs. 6
to 9) and by distances over twenty seeds.

`hidden_state_augmented.py` tries this method on the parameters of a whole record.
"""

import numpy as np
import pandas as pd
import pytensor.tensor as pt
import xarray as xr
from hidden_state_augmented import augmented_study
from hidden_state_pictures import draw_case
from scipy.stats import norm, wasserstein_distance
from study import Study, study

import pymc_statespace_filters as psf

# The thesis gives only d. alpha must not be 0, where the cosine is flat. Process noise must be
# large compared with the variance of the parameter, or the parameter too has several modes, which
# the thesis rules out.
MEASURED = -0.5
ALPHA_MEAN, ALPHA_VARIANCE = 0.8, 0.5
PROCESS_VARIANCE, NOISE_VARIANCE = 2.0, 0.1
SHARPER = (0.1, 0.01, 0.001)  # variances of more precise sensors

CASES = {"I-I": (0, 0), "I-II": (0, 1), "II-I": (1, 0), "II-II": (1, 1)}
FIGURES = dict(zip(CASES, (6, 7, 8, 9), strict=True))
EQUATIONS = ("x = alpha + q", "x = cos(alpha) + q"), ("d = x + e", "d = cos(x) + e")
N_SEEDS = 20


def made_of_alpha(x, q, cosine_model):
    """Compute x from alpha, whatever x was; alpha does not change."""
    alpha = x[1]
    return [pt.switch(cosine_model > 0, pt.cos(alpha), alpha) + q[0], alpha]


def measurement(x, cosine_sight):
    return [pt.switch(cosine_sight > 0, pt.cos(x[0]), x[0])]


hidden_state = psf.StateSpaceModel(
    transition=made_of_alpha,
    process_noise=[[PROCESS_VARIANCE]],
    observation=measurement,
    observation_noise=lambda variance: [[variance]],
    initial_mean=[0.0, ALPHA_MEAN],
    initial_cov=[[0.0, 0.0], [0.0, ALPHA_VARIANCE]],
    states=["x", "alpha"],
)


def filters(n_particles: int) -> dict:
    return {
        "EKF": psf.EKF(),
        "EnKF": psf.EnKF(n_particles),
        "BootstrapPF": psf.BootstrapPF(n_particles),
        "PFEnKF": psf.PFEnKF(n_particles),
    }


def exact_posterior(case: str, variance: float = NOISE_VARIANCE) -> xr.DataArray:
    """Return the probabilities on a grid by Eq. 4.48 (with alpha_o for its alpha_i)."""
    g, h = (np.cos if cosine else np.positive for cosine in CASES[case])
    x = xr.DataArray(np.linspace(-9.0, 11.0, 4001), dims="x")
    alpha = xr.DataArray(np.linspace(-3.5, 5.1, 861), dims="alpha")
    exponent = (
        (MEASURED - h(x)) ** 2 / variance
        + (alpha - ALPHA_MEAN) ** 2 / ALPHA_VARIANCE
        + (x - g(alpha)) ** 2 / PROCESS_VARIANCE
    )
    density = np.exp(-0.5 * exponent).assign_coords(x=x, alpha=alpha)
    return density / density.sum()


def updated(case: str, filter, seed: int, variance: float = NOISE_VARIANCE) -> xr.Dataset:
    """Return state and parameter after the measurement, which comes one step after the start."""
    model, sight = CASES[case]
    params = {"cosine_model": model, "cosine_sight": sight, "variance": variance}
    run = psf.run_filter(hidden_state, filter, params, [MEASURED], steps=[1], seed=seed)
    return run.isel(time=0)


def weighted_values(run: xr.Dataset, exact: xr.DataArray, name: str) -> tuple:
    """Return a filter's marginal of one state as values and weights; a normal if no particles."""
    if "particles" in run:
        return run["particles"].sel(state=name).values, run["weights"].values
    mean, sd = (float(run[moment].sel(state=name)) for moment in ("mean", "sd"))
    return exact[name].values, norm.pdf(exact[name], mean, sd)


def row_of(exact: xr.DataArray, laws: list[dict]) -> dict:
    """Return the distances of several computed marginals from the exact one, and their moments."""
    row = {}
    for name in ("x", "alpha"):
        marginal = exact.sum({"x", "alpha"} - {name})
        distances = [
            wasserstein_distance(values, exact[name], weights, marginal)
            for values, weights in (law[name] for law in laws)
        ]
        means, sds = np.transpose([moments(*law[name]) for law in laws])
        row |= {
            f"distance {name}": np.mean(distances),
            f"± distance {name}": np.std(distances),
            f"mean {name}": np.mean(means),
            f"± mean {name}": np.std(means),
            f"sd {name}": np.mean(sds),
        }
    return row


def moments(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    mean = np.average(values, weights=weights)
    return mean, np.sqrt(np.average((values - mean) ** 2, weights=weights))


def independent_draws(exact: xr.DataArray, n: int, seed: int) -> dict:
    """Draw from the exact posterior: no ensemble of this size can be expected to do better."""
    points = exact.stack(point=("x", "alpha"))
    chosen = np.random.default_rng(seed).choice(points.size, n, p=points)
    return {name: (points[name].values[chosen], np.ones(n)) for name in ("x", "alpha")}


def law_of(run: xr.Dataset, exact: xr.DataArray) -> dict:
    return {name: weighted_values(run, exact, name) for name in ("x", "alpha")}


def case_study(settings: Study, case: str) -> pd.DataFrame:
    """Draw the figure of a case and return its rows of the table of distances."""
    exact = exact_posterior(case)
    whole = {name: (exact[name].values, exact.sum({"x", "alpha"} - {name})) for name in exact.dims}
    seeds = range(settings.seed, settings.seed + N_SEEDS)
    n = settings.particles
    sampled = [independent_draws(exact, n, seed) for seed in seeds]
    rows = {
        "exact": row_of(exact, [whole]),
        "exact draws": row_of(exact, sampled),
    }
    first = {}
    for name, filter in filters(n).items():
        runs = [updated(case, filter, seed) for seed in (seeds if filter.noisy else seeds[:1])]
        rows[name] = row_of(exact, [law_of(run, exact) for run in runs])
        first[name] = runs[0]
    equations = [names[cosine] for names, cosine in zip(EQUATIONS, CASES[case], strict=True)]
    figure = draw_case(f"Case {case}: {', '.join(equations)}", exact, first)
    settings.picture(f"figure_{FIGURES[case]}", figure)
    return pd.DataFrame(rows).T


def sharper_measurements(settings: Study) -> pd.DataFrame:
    """Return distances in x of the two particle filters for more and more precise measurements."""
    rows = {}
    for case in ("I-I", "I-II"):
        for variance in SHARPER:
            exact = exact_posterior(case, variance)
            row = rows[case, str(variance)] = {}
            for name in ("BootstrapPF", "PFEnKF"):
                filter = filters(settings.particles)[name]
                runs = [updated(case, filter, settings.seed + i, variance) for i in range(N_SEEDS)]
                found = row_of(exact, [law_of(run, exact) for run in runs])
                row |= {name: found["distance x"], f"± {name}": found["± distance x"]}
    return pd.DataFrame(rows).T.rename_axis(["case", "variance of e"])


def check(table: pd.DataFrame) -> None:
    """Stop unless the table supports the claims of the page."""
    x, sd, error = (table[column] for column in ("distance x", "sd x", "± mean x"))
    for name in filters(2):
        if x["I-I", name] > 3 * x["I-I", "exact draws"]:
            raise SystemExit(f"{name} must agree with the exact posterior in case I-I")
    if error["I-I", "PFEnKF"] > error["I-I", "BootstrapPF"]:
        raise SystemExit("PFEnKF must have the smaller noise in case I-I")
    for case in ("I-II", "II-II"):
        if sd[case, "EKF"] > 0.5 * sd[case, "exact"]:
            raise SystemExit(f"the EKF must track one mode alone in case {case}")
        if not x[case, "BootstrapPF"] < x[case, "PFEnKF"] < 0.5 * x[case, "EnKF"]:
            raise SystemExit(f"BootstrapPF, PFEnKF, EnKF must come in this order in case {case}")


def main() -> None:
    settings = study(__doc__, "hidden_state", draws=8000, particles=2000, quick=(800, 2000))
    table = pd.concat({case: case_study(settings, case) for case in CASES}, names=["case", "law"])
    settings.table("distances", table, digits=3)
    settings.table("sharper", sharper_measurements(settings), digits=3)
    check(table)
    augmented = augmented_study(settings, filters(settings.particles))
    pd.set_option("display.width", 160, "display.max_columns", 20)
    print(table.round(3), augmented.round(2), sep="\n\n")


if __name__ == "__main__":
    main()
