"""Which nonlinearities does the record of a vibrating mass show? Eight rivals for each of three.

The thesis estimates the parameters of a mass on a spring with cubic stiffness, freeplay and
hysteresis (Section 5.3), and ends: "Model selection is not carried out for this system due to
extremely high computational time". Here it is carried out. Each nonlinearity is either in the model
or not, which makes eight variants with three to nine parameters. The simulation had all three. How
much of that can a noisy record of the displacement show?

For the records of cases 1 to 3, every variant is sampled with an extended and with an ensemble
Kalman filter, the two best also with PF-EnKF. The draws give its evidence, its probability, the
probability of each nonlinearity, and the restoring force averaged over the variants.
"""

import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from model_choice_pictures import plot_forces, plot_probabilities
from oscillator import CASES, NONLINEARITIES, TRUTH, restoring_force
from oscillator_models import model_of
from scipy.special import softmax
from study import Study, check, mixing, study

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence import Evidence

# The first case as printed does not move enough to show anything (see `oscillator.py`), and takes
# the three stiffnesses as equal. Here no record does: all have the same eight rivals.
RECORDS = {
    "case 1": replace(CASES["case 1, T = 3"], shared=False),
    "case 2": CASES["case 2, dense"],
    "case 3": CASES["case 3"],
}
VARIANTS = {
    " + ".join(chosen) or "linear": chosen
    for size in range(4)
    for chosen in combinations(NONLINEARITIES, size)
}
QUICK_RECORD = SENSITIVITY_RECORD = "case 2"
PF_ENKF_SHARE = 5  # of the draws: PF-EnKF takes three to eight times as long as an EnKF
BRIDGED = ("case 3", "cubic + hysteresis")  # also by bridge sampling with the ensemble

# The tables show the warnings of an evidence: few effective draws, large R-hat.
warnings.filterwarnings("ignore", category=psf.errors.EvidenceWarning)

# Chains from the prior need this long to find and learn a ridge; with the EKF it takes seconds.
PILOT = {"draws": 12_500, "tune": 7500}
QUICK_PILOT = {"draws": 1000, "tune": 2500}

FORCE_PLACES = np.linspace(-1.75, 1.75, 71)  # the range of the motion


@dataclass(frozen=True)
class Sampled:
    """Draws of one variant, its evidence by each estimator, and the CPU seconds they took."""

    idata: xr.DataTree
    evidence: dict[str, Evidence]
    seconds: float

    @property
    def calls(self) -> int:
        """Evaluations of the likelihood for the kept draws."""
        return int(self.idata["sample_stats"]["n_evaluations"].sum())


def sample(
    settings: Study,
    place: str,
    model: pm.Model,
    *,
    n_proposals: int | None = None,
    bridge: bool = False,
    **sampling: Any,
) -> Sampled:
    """Return draws and evidence of a model; an interrupted run resumes.

    An earlier run is identified by folders and a file named after `place`. Seconds are those of
    this process; if a chain was resumed, those of the rest only.
    """
    started = time.process_time()
    idata = settings.sample(place, model, **sampling)

    def find() -> dict[str, Any]:
        seed = settings.seed
        found = {
            "chib_jeliazkov": psf.chib_jeliazkov(
                idata, model, n_proposals=n_proposals, random_seed=seed
            )
        }
        if bridge:
            found |= psf.estimate_evidence(idata, model, estimators=["bridge"], random_seed=seed)
        evidence = {name: asdict(one) for name, one in found.items()}
        return {"seconds": time.process_time() - started, "evidence": evidence}

    left = settings.kept(place, idata, find)
    evidence = {name: Evidence(**values) for name, values in left["evidence"].items()}
    return Sampled(idata, evidence, left["seconds"])


def pilots(settings: Study, record: str, width: float = 1.0) -> dict[str, Sampled]:
    """Sample all variants by the EKF, from the prior, which may be widened."""
    place = f"{record}/EKF" if width == 1 else f"{record}/EKF, priors times {width:g}"
    return {
        variant: sample(
            settings,
            f"{place}/{variant}",
            model_of(RECORDS[record], psf.EKF(), VARIANTS[variant], wider=width),
            bridge=not settings.quick,
            kernel={"stages": (3, 1)},
            **(QUICK_PILOT if settings.quick else PILOT),
        )
        for variant in VARIANTS
    }


def refined(
    settings: Study, record: str, filter: psf.EnKF | psf.PFEnKF, pilot: Mapping[str, Sampled]
) -> dict[str, Sampled]:
    """Sample variants by an ensemble, with starts and proposals from the pilots.

    The EKF also screens the proposals. It rejects most of them at its own cost, some hundredths of
    the ensemble's, and the chain is still correct for the ensemble's likelihood. The covariance of
    the proposals is not adapted: a shorter run could only learn a worse one.
    """
    found = {}
    for variant, sampled in pilot.items():
        model = model_of(RECORDS[record], filter, VARIANTS[variant])
        found[variant] = sample(
            settings,
            f"{record}/{type(filter).__name__}/{variant}",
            model,
            # Their error is then below that of the draws, and they cost less than these.
            n_proposals=max(2000, settings.draws // 10),
            bridge=(record, variant) == BRIDGED and isinstance(filter, psf.EnKF),
            pilot=sampled.idata,
            kernel={"screen": psf.EKF(), "stages": 1},
        )
    return found


def chib_jeliazkov(found: Mapping[str, Sampled]) -> dict[str, Evidence]:
    return {variant: sampled.evidence["chib_jeliazkov"] for variant, sampled in found.items()}


def compared(found: Mapping[str, Sampled]) -> pd.DataFrame:
    """Return evidence and probability of the variants of one record, by one filter."""
    table = psf.compare_evidence(chib_jeliazkov(found))
    parameters = table["n_parameters"]
    shown = table[["log_evidence", "se", "prob", "prob_low", "prob_high"]].copy()
    shown.insert(0, "parameters", parameters)
    shown["max ln L"] = parameters - table["aic"] / 2
    mixed = pd.DataFrame({variant: mixing(sampled.idata) for variant, sampled in found.items()}).T
    shown[["r_hat", "ess"]] = mixed[["R-hat", "effective draws"]]
    for name in ("calls", "seconds"):
        shown[name] = [getattr(found[variant], name) for variant in shown.index]
    return shown


def overview(tables: Mapping[tuple[str, str], pd.DataFrame]) -> pd.DataFrame:
    """Return log-evidence, error and probability: a row per variant, a column per filter."""
    columns = {
        " ".join(place): table.apply(
            lambda row: f"{row.log_evidence:.2f} ± {row.se:.2f} ({row.prob:.2f})", axis=1
        )
        for place, table in tables.items()
    }
    return pd.DataFrame(columns).reindex(VARIANTS).rename_axis("model").fillna("")


def shown_nonlinearities(table: pd.DataFrame) -> pd.DataFrame:
    """Return the probability of each nonlinearity: the sum over the variants that have it.

    The 95 % interval is what the errors of the evidences leave open.
    """
    rng = np.random.default_rng(1)
    errors = rng.normal(size=(10_000, len(table))) * table["se"].to_numpy()
    probs = softmax(table["log_evidence"].to_numpy() + errors, axis=1)
    rows = {}
    for name in NONLINEARITIES:
        has = [name in VARIANTS[variant] for variant in table.index]
        low, high = np.quantile(probs[:, has].sum(1), [0.025, 0.975])
        rows[name] = {"prob": table["prob"][has].sum(), "prob_low": low, "prob_high": high}
    return pd.DataFrame(rows).T.rename_axis("nonlinearity")


def forces(posterior: xr.Dataset) -> xr.DataArray:
    """Return the springs' force on the way up and down, at every tenth draw."""
    some = posterior.isel(draw=slice(None, None, 10))
    numbers = {name: some[name].values for name in TRUTH if name in some}
    both = [restoring_force(FORCE_PLACES, direction, numbers) for direction in (1.0, -1.0)]
    dims = ("direction", "chain", "draw", "displacement")
    coords = {"direction": ["up", "down"], "displacement": FORCE_PLACES}
    return xr.DataArray(both, coords, dims, name="force").transpose("chain", "draw", ...)


def agreement(found: Mapping[str, Sampled]) -> pd.DataFrame:
    """Compare evidences by the method of Chib and Jeliazkov with those by bridge sampling."""
    rows = {}
    for variant, sampled in found.items():
        if "bridge" in sampled.evidence:
            ours, other = sampled.evidence["chib_jeliazkov"], sampled.evidence["bridge"]
            rows[variant] = {
                "Chib-Jeliazkov": ours.log_evidence,
                "se": ours.se,
                "bridge": other.log_evidence,
                "se of bridge": other.se,
                "z": (ours.log_evidence - other.log_evidence) / np.hypot(ours.se, other.se),
            }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("model")


def sampled_by_filters(settings: Study, record: str) -> dict[str, dict[str, Sampled]]:
    """Sample all variants by EKF and EnKF, the two best by PF-EnKF; if quick, the best by EnKF."""
    found = {"EKF": pilots(settings, record)}

    def best(filter: str, number: int) -> dict[str, Sampled]:
        first = compared(found[filter]).index[:number]
        return {variant: found["EKF"][variant] for variant in first}

    chosen = best("EKF", 1) if settings.quick else found["EKF"]
    found["EnKF"] = refined(settings, record, psf.EnKF(settings.particles), chosen)
    if not settings.quick:
        fewer = replace(settings, draws=settings.draws // PF_ENKF_SHARE)
        pf_enkf = psf.PFEnKF(settings.particles)
        found["PF-EnKF"] = refined(fewer, record, pf_enkf, best("EnKF", 2))
    return found


def sensitivity(settings: Study, record: str) -> pd.DataFrame:
    """Return nonlinearities' probabilities by the EKF with all priors half or twice as wide.

    The posteriors are sampled again: most of them are so wide that reweighting their draws
    (`psf.prior_sensitivity`) gives no answer.
    """
    probs = {}
    for width in (0.5, 1.0, 2.0):
        table = compared(pilots(settings, record, width))
        probs[f"priors times {width:g}"] = shown_nonlinearities(table)["prob"]
    return pd.DataFrame(probs)


def check_verdicts(shown: Mapping[tuple[str, str], pd.DataFrame]) -> None:
    """Stop unless the claims of the study hold; the tables are already written."""
    for (record, filter), table in shown.items():
        prob, by = table["prob"], f"by {filter}"
        check(f"{record} shows the cubic stiffness, {by}", prob["cubic"] > 0.9)
        if record == "case 1":
            check(f"{record} leaves the hysteresis open, {by}", 0.1 < prob["hysteresis"] < 0.9)
        else:
            check(f"{record} shows the hysteresis, {by}", prob["hysteresis"] > 0.9)
        check(f"{record} leaves the freeplay open, {by}", 0.1 < prob["freeplay"] < 0.9)


def main() -> None:
    settings = study(__doc__, "model_choice", draws=50_000, particles=1250, quick=(4000, 30))
    tables, shown, averages, checks = {}, {}, {}, {}
    for record in [QUICK_RECORD] if settings.quick else RECORDS:
        for filter, found in sampled_by_filters(settings, record).items():
            tables[record, filter] = table = compared(found)
            checks[record, filter] = agreement(found)
            if len(found) == len(VARIANTS):  # the last filter whose results are averaged
                shown[record, filter] = shown_nonlinearities(table)
                trees = {variant: sampled.idata for variant, sampled in found.items()}
                weights = psf.compare_evidence(chib_jeliazkov(found))
                averages[record] = psf.average_models(trees, weights, forces, random_seed=1)

    levels = ["record", "filter"]
    settings.table("overview", overview(tables))
    settings.table("evidences", pd.concat(tables, names=levels))
    settings.table("nonlinearities", pd.concat(shown, names=levels))
    settings.picture("probabilities", plot_probabilities(tables))
    settings.picture("forces", plot_forces(averages))
    if not settings.quick:
        settings.table("estimators", pd.concat(checks, names=levels))
        settings.table("priors", sensitivity(settings, SENSITIVITY_RECORD))
    print(pd.concat(shown, names=levels).round(3).to_string())
    check_verdicts(shown)


if __name__ == "__main__":
    main()
