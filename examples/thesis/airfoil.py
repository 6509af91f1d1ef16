"""Which spring holds a fluttering wing in its limit cycle? Two records, and a higher speed.

This is the future work that the thesis proposes, on simulated records. Past its flutter speed a
wing section does not diverge but goes into a limit cycle, because its pitch spring hardens: either
it is cubic, or it has freeplay and a stop. Plunge and pitch are measured with noise, three times a
cycle, first at 13 m/s and then at 15 m/s. One record is simulated with a cubic spring and one with
freeplay. Four springs compete for each: linear, cubic, freeplay, and both. The unknowns are the
stiffnesses, the damping in pitch and the strength of the gusts; the rest of the section is known
(`airfoil_section.py`).

An engineer would ask: does one speed distinguish the springs, or are two needed? Do EKF and EnKF
agree? And how far will the section pitch at 17 m/s, where there is no data?
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from airfoil_pictures import draw_moments, draw_peaks, draw_records
from airfoil_rivals import NEW_SPEED, PAIR, SPRINGS, Comparison, true_peaks
from airfoil_section import (
    SPEEDS,
    TRUTHS,
    airfoil,
    flutter_speed,
    flutter_table,
    simulated_record,
    step_table,
)
from study import Study, check, study

import pymc_statespace_filters as psf

# Filter performance depends on the record, so compare on several, simulated in the same way.
SEEDS, SEED_DRAWS = range(1, 9), 2000

type Comparisons = Mapping[tuple[str, str], Comparison]


def likelihood_table(settings: Study) -> pd.DataFrame:
    """Compute log-likelihoods at the truth by three filters; the bootstrap filter is unbiased."""
    filters = {
        "EKF": (psf.EKF(), 1),
        "EnKF": (psf.EnKF(settings.particles), 8),
        "bootstrap": (psf.BootstrapPF(20 * settings.particles), 4),
    }
    rows: dict = {}
    for name, seed in product(TRUTHS, SEEDS[:1] if settings.quick else SEEDS):
        r, row = simulated_record(name, seed), rows.setdefault((name, seed), {})
        for label, (filter, n_seeds) in filters.items():
            terms = psf.log_likelihood(
                airfoil,
                filter,
                TRUTHS[name],
                r.observed,
                steps=r.steps,
                inputs=r.speeds,
                seed=np.arange(n_seeds),
            )
            total = terms.sum(-1)
            row[label] = total.mean()
            if n_seeds > 1:
                row[f"sd of {label}"] = total.std(ddof=1)
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["record", "seed"])


def lead_table(settings: Study) -> pd.DataFrame:
    """Compute the lead of the true spring over the other one, on all records, by EKF.

    Also by EnKF, on the record with the smallest lead.
    """
    rows, short = {}, replace(settings, draws=SEED_DRAWS)
    for name in TRUTHS:
        found = {}
        for seed in SEEDS:
            record, folder = simulated_record(name, seed), f"{name}-{seed}"
            found[seed] = Comparison.by_ekf(short, folder, record, PAIR)
            rows[name, seed, "EKF"] = found[seed].lead(name)
        least = min(SEEDS, key=lambda seed: rows[name, seed, "EKF"]["lead"])
        by_enkf = found[least].by_enkf(settings, f"{name}-{least}-enkf")
        rows[name, least, "EnKF"] = by_enkf.lead(name)
    table = pd.DataFrame.from_dict(rows, orient="index")
    return table.rename_axis(["record", "seed", "filter"]).sort_index()


def probability_table(comparisons: Comparisons) -> pd.DataFrame:
    """Return a row for each spring, by each comparison."""
    columns = ["log_evidence", "se", "prob", "undecided", "rhat"]
    tables = {key: comparison.table[columns] for key, comparison in comparisons.items()}
    return pd.concat(tables, names=["record", "looks and filter", "spring"])


def parameter_table(comparisons: Comparisons) -> pd.DataFrame:
    """Return mean and sd of the true spring's parameters, by each comparison."""
    rows = {}
    for (record, by), comparison in comparisons.items():
        posterior = comparison.draws[record]["posterior"]
        for name, truth in TRUTHS[record].items():
            draws = posterior[name].values
            rows[record, name, by] = {"truth": truth, "mean": draws.mean(), "sd": draws.std()}
    table = pd.DataFrame.from_dict(rows, orient="index")
    return table.rename_axis(["record", "parameter", "looks and filter"])


def peak_table(peaks: Mapping[str, Mapping[str, np.ndarray]]) -> pd.DataFrame:
    """Return quantiles of the largest pitch at the new speed, in degrees."""
    rows = {
        (record, by): np.quantile(values, [0.05, 0.5, 0.95])
        for record, of in peaks.items()
        for by, values in of.items()
    }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["5 %", "50 %", "95 %"])
    table.index = pd.MultiIndex.from_tuples(table.index, names=["record", "looks and filter"])
    return table


def verdicts(comparisons: Comparisons, steps: pd.DataFrame) -> None:
    """Stop with a message unless the page's claims on the two records hold."""
    check("the speeds are past the flutter speed", flutter_speed() < min(SPEEDS))
    amplitudes = steps["amplitude [deg]"].unstack("integrator")
    kept = abs(amplitudes["this step"] / amplitudes["exact"] - 1) < 0.02
    check("the step keeps the amplitude of the limit cycles to 2 %", kept.all())
    lead = {key: comparison.lead(key[0])["lead"] for key, comparison in comparisons.items()}
    for (record, by), nats in lead.items():
        linear = comparisons[record, by].table["prob"].get("linear", 0.0)
        check(f"no linear spring makes the limit cycle ({record}, {by})", linear < 0.01)
        if by.startswith("two"):
            check(f"two speeds tell the springs apart ({record}, {by})", nats > 5)
    for record in TRUTHS:
        gain = lead[record, "two speeds, EKF"] - lead[record, "one speed, EKF"]
        check(f"the second speed is worth five nats ({record})", gain > 5)


def main() -> None:
    settings = study(__doc__, "airfoil", draws=20_000, particles=500, quick=(2000, 250))
    records = {name: simulated_record(name) for name in TRUTHS}
    settings.table("flutter", flutter_table())
    steps = step_table()
    settings.table("steps", steps)
    settings.picture("records", draw_records(records))
    settings.table("likelihoods", likelihood_table(settings), digits=1)

    found, springs = {}, PAIR if settings.quick else SPRINGS
    for name, record in records.items():
        for by, looks in {"one speed": record.first_half(), "two speeds": record}.items():
            folder = f"{name}-{by}".replace(" ", "-")
            found[name, f"{by}, EKF"] = Comparison.by_ekf(settings, folder, looks, springs)
        if not settings.quick:
            whole = found[name, "two speeds, EKF"]
            found[name, "two speeds, EnKF"] = whole.by_enkf(settings, f"{folder}-enkf")

    settings.table("probabilities", probability_table(found), digits=2)
    settings.table("parameters", parameter_table(found), digits=3)
    peaks: dict = {name: {} for name in records}
    moments: dict = {name: {} for name in records}
    for (name, by), comparison in found.items():
        peaks[name][by], moments[name][by] = comparison.peak(), comparison.moment()
    for name, record in records.items():
        peaks[name]["truth"] = true_peaks(name, record)
    settings.table("peaks", peak_table(peaks), digits=1)
    settings.picture("moments", draw_moments(moments))
    settings.picture("peaks", draw_peaks(peaks, NEW_SPEED))
    if not settings.quick:
        settings.table("leads", lead_table(settings), digits=1)
    verdicts(found, steps)


if __name__ == "__main__":
    main()
