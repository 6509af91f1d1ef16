"""Estimate every parameter of an oscillator with three nonlinearities from noisy records.

How well does a record of a worn machine part determine its force laws? A mass is held by springs
with three faults at once: they harden (cubic), they have a gap (freeplay), and they return along
another path (hysteresis). It is driven by a known force for 30 seconds and its position is
measured, with different intervals and noise. All parameters are estimated from each of five
records: nine of them, or seven where three stiffnesses are known to be equal (thesis, Section 5.3,
cases 1 to 3). The script also plots the forces, measures the cost of rounding their kinks and the
value of the gradient this gives, and shows which filters can handle a hysteresis with a memory.

The stiffness of one spring can replace that of another. In the stiffnesses the posterior is a long,
thin, bent ridge; in the forces of `oscillator_models.py` less so. The chains of the cheap extended
Kalman filter are the longest. Those of the ensemble filters start where these ended, use the same
proposals, and evaluate only the moves that the extended Kalman filter accepts.
"""

import arviz as az
import mass_spring_damper_filters as filters
import mass_spring_damper_pictures as pictures
import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from oscillator import CASES, TRUTH, Case
from oscillator_models import PRIORS, model_of
from study import Study, check, study

import pymc_statespace_filters as psf

EKF_CHAIN = 40  # times as long as those of the ensemble filters
MOST_WEIGHTED = 2000  # draws of the EKF's posterior to reweight with a PFEnKF
PILOT_MEMBERS = 100  # where the EKF cannot be used first
NUTS_CASE, NUTS_WIDTH = "case 2, sparse", 0.1
QUICK_CASE = "case 3"
# The case as printed: driven by 0.5 N, without a memory.
AS_PRINTED = Case("case 1, as printed", 0.5, 0.05, 30, seed=531)


def sample(run: Study, case: Case) -> dict[str, xr.DataTree]:
    """Sample the posteriors of a case with every filter that can handle it."""
    ensembles = {"EnKF": psf.EnKF(run.particles), "PFEnKF": psf.PFEnKF(run.particles)}
    if run.quick:
        del ensembles["PFEnKF"]
    if case.memory:
        pilot = chains(run, case, "pilot", psf.EnKF(min(run.particles, PILOT_MEMBERS)))
        return {name: chains(run, case, name, f, pilot) for name, f in ensembles.items()}
    ekf = chains(run, case, "EKF", psf.EKF(), length=EKF_CHAIN)
    found = {"EKF": ekf} | {
        name: chains(run, case, name, filter, ekf, screen=psf.EKF())
        for name, filter in ensembles.items()
    }
    filter, n_draws = psf.PFEnKF(run.particles), min(MOST_WEIGHTED, run.draws // 10)
    rng = np.random.default_rng(run.seed)
    return found | {"PFEnKF, weights": filters.reweighted(case, ekf, filter, n_draws, rng)}


def chains(
    run: Study,
    case: Case,
    name: str,
    filter: psf.EKF | psf.EnKF | psf.PFEnKF,
    pilot: xr.DataTree | None = None,
    *,
    length: int = 1,
    screen: psf.EKF | None = None,
) -> xr.DataTree:
    """Sample a posterior, starting where the chains of the pilot ended."""
    model = model_of(case, filter)
    settings = {key: length * run.sampling(name)[key] for key in ("draws", "tune")}
    # The noise of a filter is held fixed: another seed changes the log-likelihood by some 0.2, and
    # a new seed for each evaluation would nearly double the time of an EnKF.
    stages = (2, 1) if pilot is None else 1
    kernel = {"stages": stages, "refresh_noise": False, "screen": screen}
    return run.sample(f"{case.slug}_{name}", model, pilot=pilot, kernel=kernel, **settings)


def summary(found: dict[str, dict[str, xr.DataTree]]) -> pd.DataFrame:
    """Return a row for each parameter of each posterior."""
    rows = []
    for case, trees in found.items():
        for filter, tree in trees.items():
            shared = ["k_f", "k_h"] if CASES[case].shared else []
            names = [name for name in TRUTH if name in tree["posterior"] and name not in shared]
            table = az.summary(
                tree, var_names=names, kind="all", ci_kind="hdi", ci_prob=0.95, round_to="none"
            )
            for name, row in table.iterrows():
                means = tree["posterior"][name].mean("draw").values
                inside = row["hdi95_lb"] <= TRUTH[name] <= row["hdi95_ub"]
                rows.append(
                    {
                        "record": case,
                        "filter": filter,
                        "parameter": name,
                        "truth": TRUTH[name],
                        "mean": row["mean"],
                        "sd": row["sd"],
                        "95 % HPDI": f"{row['hdi95_lb']:.2f} to {row['hdi95_ub']:.2f}",
                        # The true sigma is at the end of its support, so no interval contains it in
                        # its interior.
                        "truth inside": "" if name == "sigma" else ("yes" if inside else "no"),
                        "means of the chains": f"{means.min():.2f} to {means.max():.2f}",
                        "R-hat": row["r_hat"],
                        "ESS": round(row["ess_bulk"]),
                    }
                )
    return pd.DataFrame(rows).set_index(["record", "filter", "parameter"])


def estimates(posteriors: pd.DataFrame) -> pd.DataFrame:
    """Return mean and 95 % HPDI of each parameter of each record, by the best of its posteriors.

    This is the reweighted one by PFEnKF or, where there is no EKF, the PFEnKF's own chains. A star
    marks a truth outside the interval.
    """
    cells = {}
    for record, rows in posteriors.groupby(level="record", sort=False):
        names = rows.index.get_level_values("filter").unique()
        best = next(name for name in ("PFEnKF, weights", "PFEnKF", "EnKF") if name in names)
        rows = rows.xs((record, best), level=("record", "filter"))
        star = rows["truth inside"].map({"no": " *"}).fillna("")
        cells[record] = rows["mean"].map("{:.2f} (".format) + rows["95 % HPDI"] + ")" + star
    table = pd.DataFrame(cells).reindex(list(TRUTH)).fillna("")
    table.insert(0, "truth", pd.Series(TRUTH))
    return table.rename_axis("parameter")


def mixing(posteriors: pd.DataFrame, found: dict[str, dict[str, xr.DataTree]]) -> pd.DataFrame:
    """Return convergence diagnostics of the worst parameter of each posterior."""
    groups = posteriors.groupby(level=["record", "filter"], sort=False)
    table = pd.DataFrame(
        {"largest R-hat": groups["R-hat"].max(), "smallest ESS": groups["ESS"].min()}
    )
    table["worth of a weighted draw"] = [
        found[record][filter].attrs.get("efficiency", np.nan) for record, filter in table.index
    ]
    return table


def by_gradient(run: Study, ekf: xr.DataTree) -> xr.DataTree:
    """Run NUTS with the EKF and rounded kinks: a hundredth of the draws, in each chain."""
    draws = max(200, run.draws // 100)
    last = ekf["posterior"].isel(draw=-1)
    start = [{name: last[name].values[chain] for name in PRIORS} for chain in range(4)]
    with pm.Model():
        # Use the parameters themselves, with distant bounds: a gradient follows a bent ridge, and
        # stops at a wall.
        for name, prior in PRIORS.items():
            prior(name)
        CASES[NUTS_CASE].observe(psf.EKF(), NUTS_WIDTH)
        return pm.sample(draws, tune=draws, chains=4, cores=2, initvals=start, random_seed=run.seed)


def check_verdicts(rows: pd.DataFrame, posteriors: pd.DataFrame) -> None:
    """Stop unless the claims of the page hold; the tables are already written."""
    sticks, moves = (
        np.ptp(case.record()["states"].sel(state="displacement").values[1500:])
        for case in (AS_PRINTED, CASES["case 1, memory"])
    )
    check("case 1 sticks as printed, and moves with a memory", sticks < 0.05 < 0.5 < moves)
    ensembles = ["EnKF", "PFEnKF", "BootstrapPF"]
    velocity_rule = rows.dropna()
    values = velocity_rule[["EKF", *ensembles]]
    spread = values.max(axis=1) - values.min(axis=1)
    se = velocity_rule[[f"sd {name}" for name in ensembles]].max(axis=1) / np.sqrt(filters.N_SEEDS)
    check("without a memory all filters agree at the truth", (spread < 1.5 + 2 * se).all())
    branches = rows.loc[f"case 1, memory, from {filters.PULLED_OUT} m"]
    others = max(branches["EnKF"], branches["PFEnKF"])
    check("only the bootstrap filter drops a wrong branch", branches["BootstrapPF"] > others + 5)
    inside = posteriors["truth inside"].xs("EKF", level="filter").unstack("parameter")
    check("k_nl and c are in their 95 % intervals", (inside[["k_nl", "c"]] == "yes").all(axis=None))


def main(run: Study) -> None:
    run.picture("forces", pictures.forces())
    run.picture("records", pictures.records())
    run.table("widths", filters.cost_of_rounding(), digits=3)
    at_the_truth = filters.at_the_truth(run.particles)
    shown = at_the_truth.astype(object).where(at_the_truth.notna(), "refused")
    run.table("filters", shown)
    found = {}
    for name in [QUICK_CASE] if run.quick else CASES:
        found[name] = sample(run, CASES[name])
        run.picture(f"posterior_{CASES[name].slug}", pictures.posteriors(name, found[name]))
    if not run.quick:
        found[NUTS_CASE]["NUTS on EKF"] = by_gradient(run, found[NUTS_CASE]["EKF"])
    posteriors = summary(found)
    run.table("posteriors", posteriors)
    run.table("estimates", estimates(posteriors))
    run.table("mixing", mixing(posteriors, found))
    check_verdicts(at_the_truth, posteriors)
    print(estimates(posteriors).to_string())


if __name__ == "__main__":
    main(study(__doc__, "mass_spring_damper", draws=50_000, particles=1250, quick=(2_000, 200)))
