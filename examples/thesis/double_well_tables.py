"""The tables of section 5.2, each number next to the one printed in the thesis."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import arviz as az
import pandas as pd
from dimension import dimension_prior
from marginal_modes import marginal_modes
from study import Study

import pymc_statespace_filters as psf

PRINTED = Path(__file__).parent / "printed"
PARAMETERS = ["alpha", "beta", "gamma", "sigma_m"]
EXPONENT = 3.0  # of the correction: not stated for 5.2, but Tables 5-7 follow from 101^1.5
J_PRINTED = 101  # the number used to correct Tables 16 and 17, although case 3 has 21 observations
UNCORRECTED = "density one"


def probabilities(
    posteriors: Mapping,
    filter: str,
    *,
    corrected: bool = False,
    n_observations: int | None = None,
    uniform: bool = False,
) -> pd.DataFrame:
    """Return the probability of each equation by one filter, as `compare_evidence` does.

    The thesis integrates the likelihood under a density of one, whatever the support (Eq. 3.7).
    This weights each equation by the volume of its support. `uniform` priors integrate to one.
    """
    found = {model: post.evidence for (name, model), post in posteriors.items() if name == filter}
    if n_observations is not None:
        found = {model: replace(one, n_observations=n_observations) for model, one in found.items()}
    volumes = {model: math.exp(one.log_volume) for model, one in found.items()}
    prior = dict.fromkeys(found, 1.0) if uniform else volumes
    if corrected:
        weights = dimension_prior(found, EXPONENT)
        prior = {model: weights[model] * prior[model] for model in found}
    return psf.compare_evidence(found, model_prior=prior).sort_index()


def write_tables(settings: Study, case: int, posteriors: Mapping) -> None:
    """Write the tables of one case, 3-7, 8-12 or 13-17, and the convergence of its chains."""
    settings.table(f"intervals_{case}", parameters_table(case, posteriors, _interval))
    settings.table(f"modes_{case}", parameters_table(case, posteriors, _mode))
    settings.table(f"probabilities_{case}", _probabilities_table(case, posteriors))
    settings.table(f"chains_{case}", _chains(posteriors))


def parameters_table(case: int, posteriors: Mapping, cell: Callable) -> pd.DataFrame:
    """Return a cell for every parameter (rows) and equation (columns), ours and the thesis's."""
    ours = _cells(_parameters(posteriors), cell)
    filters = dict.fromkeys(name for name, _ in posteriors)
    rows = [(filter, name) for filter in filters for name in PARAMETERS]
    return _beside(ours.loc[rows], _cells(_printed("double_well_parameters", case), cell))


def wide_table(posteriors: Mapping[int, Mapping]) -> pd.DataFrame:
    """Return 95 % intervals of all cases under the wide supports."""
    tables = {case: parameters_table(case, post, _interval) for case, post in posteriors.items()}
    return pd.concat(tables, names=["case"])


def evidence_table(posteriors: Mapping[int, Mapping]) -> pd.DataFrame:
    """Return log-evidences under a density of one, with standard errors; one column per filter."""
    rows: dict[tuple[int, str], dict] = {}
    for case, of_case in posteriors.items():
        for (filter, model), post in of_case.items():
            flat = post.evidence.log_evidence + post.evidence.log_volume
            cell = f"{flat:.2f} ± {post.evidence.se:.2f}"
            rows.setdefault((case, model), {})[filter] = cell
    return _frame(rows, ["case", "equation"])


def largest_table(posteriors: Mapping[int, Mapping]) -> pd.DataFrame:
    """Return the largest log-likelihood that each filter finds."""
    rows: dict[tuple[int, str], dict] = {}
    for case, of_case in posteriors.items():
        for (filter, model), post in of_case.items():
            rows.setdefault((case, model), {})[filter] = post.evidence.max_log_likelihood
    return _frame(rows, ["case", "equation"])


def _frame(rows: Mapping[tuple, dict], names: list[str]) -> pd.DataFrame:
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(names)


def _printed(name: str, case: int) -> pd.DataFrame:
    return pd.read_csv(PRINTED / f"{name}.csv").query("case == @case")


def _parameters(posteriors: Mapping) -> pd.DataFrame:
    """Return interval and mode of every marginal; columns as in the printed table."""
    rows = []
    for (filter, model), post in posteriors.items():
        intervals = az.hdi(post.draws, prob=0.95)
        modes = marginal_modes(post.draws).loc["posterior"]
        for name in modes.index:
            rows.append((filter, name, model, *intervals[name].values, modes[name]))
    return pd.DataFrame(rows, columns=["filter", "parameter", "model", "low", "high", "mode"])


def _interval(row: pd.Series) -> str:
    return f"[{row['low']:.2f}, {row['high']:.2f}]"


def _mode(row: pd.Series) -> str:
    return f"{row['mode']:.2f}"


def _cells(frame: pd.DataFrame, cell: Callable[[pd.Series], str]) -> pd.DataFrame:
    """Return one row for each filter and parameter, one column for each equation."""
    written = frame.assign(cell=frame.apply(cell, axis=1))
    return written.pivot(index=["filter", "parameter"], columns="model", values="cell")


def _beside(ours: pd.DataFrame, printed: pd.DataFrame) -> pd.DataFrame:
    """Interleave our columns with the thesis's."""
    both = ours.join(printed.add_suffix(", 2013")).fillna("")
    return both[sorted(both.columns)]


def _probabilities_table(case: int, posteriors: Mapping) -> pd.DataFrame:
    """Return probabilities in per cent, with 95 % intervals for the numerical error."""
    (j,) = {post.evidence.n_observations for post in posteriors.values()}
    priors: dict[str, dict] = {UNCORRECTED: {}}
    priors |= {_corrected(n): {"corrected": True, "n_observations": n} for n in (j, J_PRINTED)}
    priors["uniform on the support"] = {"uniform": True}
    rows = {
        (filter, name): probabilities(posteriors, filter, **prior).apply(_percent, axis=1)
        for filter in dict.fromkeys(name for name, _ in posteriors)
        for name, prior in priors.items()
    }
    printed = _printed("double_well_probabilities", case)
    # Whatever the number of observations, the thesis's J is 101.
    names = printed["corrected"].map({"no": UNCORRECTED, "yes": _corrected(J_PRINTED)})
    printed = printed.assign(prior=names).set_index(["filter", "prior"])
    models = list(dict.fromkeys(model for _, model in posteriors))
    return _beside(_frame(rows, ["filter", "prior"]), printed[models].map("{:.2f}".format))


def _corrected(n_observations: int) -> str:
    return f"corrected, J = {n_observations}"


def _percent(row: pd.Series) -> str:
    low, mean, high = (f"{100 * row[name]:.2f}" for name in ("prob_low", "prob", "prob_high"))
    return mean if low == high else f"{mean} ({low} to {high})"


def _chains(posteriors: Mapping) -> pd.DataFrame:
    """Return convergence diagnostics of the chains and warnings of the evidence."""
    rows = {}
    for (filter, model), post in posteriors.items():
        rows[filter, model] = {
            "R-hat": max(float(one) for one in az.rhat(post.draws).values()),
            "effective draws": round(min(float(one) for one in az.ess(post.draws).values())),
            "doubts": post.evidence.doubts,
        }
    return _frame(rows, ["filter", "equation"])
