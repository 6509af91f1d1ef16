"""Are likelihood and evidence right? A linear system, for which exact numbers are known.

A position is pushed by white noise and measured: a linear system, for which the Kalman filter is
exact. Two questions, those of section 5.1 of the thesis:

* What do the ensemble filters give in place of the exact likelihood (Table 2)?
* Four models claim to have made the record (Eqs. 5.9-5.12):

      M1: dx = sigma dW                  M3: dx = a2 x dt + sigma dW
      M2: dx = a1 dt + sigma dW          M4: dx = (a1 + a2 x) dt + sigma dW

  M1 did. Which one does the evidence choose under flat priors, with how many measurements, and what
  does the correction for the number of parameters change (Fig. 10)? One record can say anything,
  so there are many, and evidences by quadrature; the estimate of Chib and Jeliazkov from posterior
  draws is held against them.

Flat priors have density one, as in the thesis, on supports that must be stated: `SUPPORTS`.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from rich.progress import track
from study import Study, check, study
from validation_choice import chosen, corrected, crossings
from validation_evidence import Rule, flat_evidences, gauss_legendre
from validation_pictures import plot_evidences, plot_probabilities

import pymc_statespace_filters as psf

DT = 0.01
TRUTH = {"sigma": 1.0}
# Every record is simulated with its own number as the seed; record 1 is the one of the tables. What
# is asked of it is only what the thesis says: made by M1, dt = 0.01, noise 0.05.
FIRST_RECORD = 1

PRINTED = {"EKF (KF)": 126.69, "PFEnKF": 126.62, "EnKF": 126.61}
RIVALS = {
    "M1": ("sigma",),
    "M2": ("sigma", "a1"),
    "M3": ("sigma", "a2"),
    "M4": ("sigma", "a1", "a2"),
}
SUPPORTS = {"sigma": (0.0, 5.0), "a1": (-100.0, 100.0), "a2": (-100.0, 100.0)}
COUNTS = (5, 7, 9, 11, 13, 15, 17, 19, 21, 25, 31, 41, 51, 61, 81, 101, 151, 201)


def drift(x, a1=0.0, a2=0.0):
    return [a1 + a2 * x[0]]


def diffusion(sigma):
    return [[sigma]]


def position(x):
    return [x[0]]


# "N(0, 0.05)" of Eq. 5.3: the printed evidences fit only if 0.05 is the standard deviation.
def measurement_noise(variance=0.05**2):
    return [[variance]]


walk = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=DT),
    observation=position,
    observation_noise=measurement_noise,
    initial_mean=[0.0],
    initial_cov=[[1.0]],
    states=["x"],
    observables=["position"],
)


@dataclass(frozen=True)
class Design:
    """How a record is measured, and how far the flat priors of a1 and a2 reach."""

    spacing: int  # steps from one measurement to the next
    n_observations: int
    variance: float = 0.05**2
    bound: float = SUPPORTS["a2"][1]

    @property
    def steps(self) -> np.ndarray:
        return self.spacing * np.arange(self.n_observations)

    @property
    def counts(self) -> list[int]:
        return [count for count in COUNTS if count <= self.n_observations]

    def record(self, seed: int) -> np.ndarray:
        truth = TRUTH | {"variance": self.variance}
        record = psf.simulate(walk, truth, steps=self.steps, random_seed=seed)
        return record["observations"].values[:, 0]

    def rules(self, fineness: int = 1) -> tuple[Rule, Rule]:
        """Quadratures over sigma and a2; twice the nodes change ln p(D) by 0.002 at most."""
        sigma = gauss_legendre(96 * fineness, *SUPPORTS["sigma"], power=2)
        return sigma, gauss_legendre(128 * fineness, -self.bound, self.bound, power=5)

    def evidences(self, values: np.ndarray, sigma: Rule, a2: Rule) -> xr.DataArray:
        """Log-evidences of the rivals, from the first J values, for every J of `counts`."""

        def log_likelihood(sigma, a1, a2):
            params = {"sigma": sigma, "a1": a1, "a2": a2, "variance": self.variance}
            terms = psf.log_likelihood(walk, psf.EKF(), params, values, steps=self.steps)
            return terms.cumsum(axis=-1)[..., np.array(self.counts) - 1]

        found = flat_evidences(log_likelihood, sigma, self.bound, a2)
        k = np.array([len(names) for names in RIVALS.values()])
        log_volume = np.log(SUPPORTS["sigma"][1]) + (k - 1) * np.log(2 * self.bound)
        of_models = {"k": ("model", k), "log_volume": ("model", log_volume)}
        coords = {"model": list(RIVALS), "J": self.counts} | of_models
        return xr.DataArray(found, coords, dims=("model", "J"))


EVERY_STEP = Design(spacing=1, n_observations=201)
MAIN_DESIGNS = {
    "every step": EVERY_STEP,
    "every 20th step": Design(spacing=20, n_observations=201),
}
DESIGNS = MAIN_DESIGNS | {
    "every step, a1 and a2 within 10": Design(1, 201, bound=10.0),
    "every step, variance 0.05": Design(1, 201, variance=0.05),
}


def readings() -> pd.DataFrame:
    """What ln p(D) must be, by the reading of "N(0, 0.05)", and how far the print is from it.

    At the true parameters the innovations are independent normals whose variances do not depend on
    the data: ln p(D) has the mean sum_j -ln(2 pi e S_j) / 2 and the variance J / 2, exactly.
    """
    printed, rows = PRINTED["EKF (KF)"], {}
    for name, variance in {"standard deviation": 0.05**2, "variance": 0.05}.items():
        for spacing in (1, 2, 5, 20):
            steps = spacing * np.arange(1000)
            params = TRUTH | {"variance": variance}
            # On a record of zeros every innovation is zero, and a term is -ln(2 pi S_j) / 2.
            terms = psf.log_likelihood(walk, psf.EKF(), params, np.zeros(1000), steps=steps)
            mean, sd = np.cumsum(terms - 0.5), np.sqrt(np.arange(1, 1001) / 2)
            z = (printed - mean) / sd
            grows = terms[-1] > 0.5
            rows[name, spacing] = {
                "nats per measurement": terms[-1] - 0.5,
                "mean, J = 201": mean[200],
                "sd": sd[200],
                "z of 126.69": z[200],
                "smallest z, any J": 0.0 if grows else z.min(),
            }
    return pd.DataFrame(rows).T.rename_axis(["0.05 is the", "spacing"])


def table_2(settings: Study) -> pd.DataFrame:
    """ln p(D) of one record by every filter; of the noisy ones, mean and scatter over seeds."""
    n = settings.particles
    filters = {
        "EKF (KF)": psf.EKF(),
        "PFEnKF": psf.PFEnKF(n),
        "EnKF": psf.EnKF(n),
        "BootstrapPF": psf.BootstrapPF(n),
        "GridFilter": psf.GridFilter(),
    }
    if settings.quick:  # machine code of the others takes longer to make than all the rest
        filters = {name: filters[name] for name in ("EKF (KF)", "EnKF")}
    seeds = settings.seed + np.arange(8 if settings.quick else 40)
    values, rows = EVERY_STEP.record(FIRST_RECORD), {}
    for name, filter in track(filters.items(), "filters"):
        found = psf.log_likelihood(
            walk, filter, TRUTH, values, steps=EVERY_STEP.steps, seed=seeds
        ).sum(axis=-1)
        printed = PRINTED.get(name, np.nan)
        rows[name] = {"ln p(D)": found.mean(), "sd of one run": found.std(), "thesis": printed}
    table = pd.DataFrame(rows).T.rename_axis("filter")
    exact = table.loc["EKF (KF)"]
    table.insert(2, "less KF", table["ln p(D)"] - exact["ln p(D)"])
    table["thesis, less KF"] = table["thesis"] - exact["thesis"]
    return table


def over_records(name: str, n_records: int) -> xr.DataArray:
    """Log-evidences of the rivals on so many records of a design; (record, model, J)."""
    design, records = DESIGNS[name], range(FIRST_RECORD, FIRST_RECORD + n_records)
    rules = design.rules()
    found = [design.evidences(design.record(r), *rules) for r in track(records, name)]
    return xr.concat(found, pd.Index(records, name="record"))


def mirror() -> pd.DataFrame:
    """What the second mode adds to ln p(D): -2/dt - a2 moves a state like a2, over two steps."""
    rows = {}
    for spacing in (1, 2, 20):
        design = Design(spacing, n_observations=101)
        values, (sigma, a2) = design.record(FIRST_RECORD), design.rules()
        both = a2.and_image(lambda nodes: -2 / DT - nodes)
        one_mode, both_modes = (
            design.evidences(values, sigma, rule).sel(J=101) for rule in (a2, both)
        )
        for model in ("M3", "M4"):
            evidences = {"a2 from -100": one_mode, "a2 from -300": both_modes}
            row = {name: found.sel(model=model).item() for name, found in evidences.items()}
            rows[spacing, model] = row
    table = pd.DataFrame(rows).T.rename_axis(["spacing", "model"])
    table["gain"] = table["a2 from -300"] - table["a2 from -100"]
    return table


def rival(names: tuple[str, ...], steps: np.ndarray, values: np.ndarray) -> pm.Model:
    """A rival as a PyMC model; its Uniform priors are the flat ones over their volume."""
    with pm.Model() as model:
        for name in names:
            pm.Uniform(name, *SUPPORTS[name])
        psf.StateSpace("d", walk, psf.EKF(), steps=steps, observed=values)
    return model


def chib_jeliazkov_beside_quadrature(settings: Study) -> pd.DataFrame:
    """Evidences from posterior draws of every rival, on short and long records."""
    rows = {}
    for record in range(FIRST_RECORD, FIRST_RECORD + (1 if settings.quick else 3)):
        values, rules = EVERY_STEP.record(record), [EVERY_STEP.rules(n) for n in (1, 2)]
        exact, finer = (EVERY_STEP.evidences(values, *rule) for rule in rules)
        for count in (201,) if settings.quick else (21, 201):
            models = {
                name: rival(names, EVERY_STEP.steps[:count], values[:count])
                for name, names in RIVALS.items()
                if name in ("M1", "M4") or not settings.quick
            }
            results = settings.run_models(f"record_{record}_{count}", models)
            for name, model in models.items():
                found = psf.chib_jeliazkov(results[name], model, random_seed=settings.seed)
                at = {"model": name, "J": count}
                rows[record, count, name] = {
                    "quadrature": finer.sel(at).item(),
                    "its error": abs(finer.sel(at).item() - exact.sel(at).item()),
                    "Chib-Jeliazkov": found.log_evidence + found.log_volume,
                    "se": found.se,
                }
    table = pd.DataFrame(rows).T.rename_axis(["record", "J", "model"])
    table["z"] = (table["Chib-Jeliazkov"] - table["quadrature"]) / table["se"]
    return table


def check_verdicts(reading, filters, found, reflected, beside) -> None:
    """What the study claims; each table is already written when this is asked."""
    mean, sd = reading.loc[("standard deviation", 1), ["mean, J = 201", "sd"]]
    check("the printed ln p(D) fits a standard deviation of 0.05", abs(126.69 - mean) < 2 * sd)
    check("our record fits it", abs(filters.loc["EKF (KF)", "ln p(D)"] - mean) < 3 * sd)
    impossible = reading.loc["variance", "smallest z, any J"].min()
    check("the printed ln p(D) does not fit a variance of 0.05", impossible > 10)
    for name in MAIN_DESIGNS:
        shares = chosen(corrected(found[name])).loc[201]
        check(f"with correction M1 wins, {name}, J = 201", shares["M1"] >= 90)
        shares = chosen(found[name]).loc[5]
        check(f"without correction M4 wins, {name}, J = 5", shares["M4"] >= 90)
    shares = chosen(found["every 20th step"]).loc[201]
    check("without correction M4 wins no longer on long records", shares["M4"] < 50)
    check("a mirror mode adds ln 2", abs(reflected.loc[(2, "M3"), "gain"] - np.log(2)) < 1e-6)
    check("Chib-Jeliazkov agrees with quadrature", (beside["z"].abs() < 4).all())


def main() -> None:
    settings = study(__doc__, "validation", draws=100_000, particles=1250, quick=(10_000, 500))
    reading, filters, reflected = readings(), table_2(settings), mirror()
    settings.table("readings", reading)
    settings.table("table_2", filters.fillna(""))
    settings.table("mirror", reflected, digits=4)

    designs = MAIN_DESIGNS if settings.quick else DESIGNS
    found = {name: over_records(name, 16 if settings.quick else 100) for name in designs}
    settings.table("crossings", crossings(found))
    for name, values in found.items():
        shares = {"flat": chosen(values), "corrected": chosen(corrected(values))}
        table = pd.concat(shares, axis=1)
        table.columns = [f"{model} {prior}" for prior, model in table.columns]
        settings.table(f"chosen_{name.replace(' ', '_').replace(',', '')}", table, digits=0)
    both = {name: (found[name], corrected(found[name])) for name in MAIN_DESIGNS}
    settings.picture("figure_10", plot_evidences(*both["every step"]))
    settings.picture("probabilities", plot_probabilities(both))

    beside = chib_jeliazkov_beside_quadrature(settings)
    settings.table("chib_jeliazkov", beside, digits=3)
    print(beside.round(3).to_string())
    check_verdicts(reading, filters, found, reflected, beside)


if __name__ == "__main__":
    main()
