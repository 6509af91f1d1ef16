"""Rival pitch springs on a record of a wing section: draws, evidences, predictions."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from airfoil_section import DT, TRUTHS, Record, airfoil, pitch_moment
from study import Study, mixing

import pymc_statespace_filters as psf

COMMON = ("k_alpha", "c_alpha", "gust")
SPRINGS = {
    "linear": (),
    "cubic": ("k_3",),
    "freeplay": ("k_f", "delta"),
    "both": ("k_3", "k_f", "delta"),
}
PAIR = ("cubic", "freeplay")  # the true springs
# Half-normal priors, vague on the scale of the section: none of the springs can be negative.
SCALES = {"k_alpha": 10, "c_alpha": 0.1, "gust": 0.3, "k_3": 5000, "k_f": 100, "delta": 0.1}

# An EnKF costs fifty times as much as an EKF. It gets a fifth of the draws, and its chains start
# where those of the EKF end. With so few members the log-likelihood of a precise record varies by
# nats from seed to seed; a chain that changes its noise a little at a time sees only part of that.
ENKF_SHARE, ENKF_TUNE = 5, 300
MOVED_NOISE = {"kernel": {"stages": 1, "correlation": 0.97}}

NEW_SPEED, NEW_STEPS, N_PATHS = 17.0, round(4.0 / DT), 400
ANGLES = np.deg2rad(np.linspace(-10, 10, 41))


def rival(spring: str, filter: Any, record: Record) -> pm.Model:
    """Return the PyMC model of a record with one of the springs."""
    with pm.Model() as model:
        for name in COMMON + SPRINGS[spring]:
            # Sample the parameters themselves, not their logarithms: a spring may be absent, at
            # zero.
            pm.HalfNormal(name, SCALES[name], default_transform=None)
        psf.StateSpace(
            "d",
            airfoil,
            filter,
            steps=record.steps,
            inputs=record.speeds,
            observed=record.observed,
        )
    return model


class Comparison:
    """Rival springs on one record, with one filter: draws, evidences, probabilities."""

    def __init__(
        self, settings: Study, name: str, record: Record, models: dict[str, pm.Model], draws: dict
    ) -> None:
        self.record, self.models, self.draws, self.seed = record, models, draws, settings.seed
        self.table = psf.compare_evidence(
            {of: settings.evidence(f"{name}-{of}", draws[of], models[of]) for of in models}
        )
        self.table["rhat"] = pd.Series({of: mixing(draws[of])["R-hat"] for of in draws})

    @classmethod
    def by_ekf(
        cls, settings: Study, name: str, record: Record, springs: Iterable[str]
    ) -> "Comparison":
        """Sample the springs on a record by an EKF; `name` names the folder of the chains."""
        models = {spring: rival(spring, psf.EKF(), record) for spring in springs}
        sampling = {
            "tune": max(1000, settings.draws // 16),
            "compute_convergence_checks": False,  # R-hat is in the table
        }
        simple = {spring: model for spring, model in models.items() if spring != "both"}
        draws = settings.run_models(name, simple, **sampling)
        if "both" in models:
            # From the prior, some chains find only the worse of the two springs and stay there.
            best = max(PAIR, key=lambda spring: float(draws[spring]["sample_stats"]["lp"].max()))
            begin = _ends(draws[best], "both")
            draws["both"] = settings.sample(
                f"{name}-both", models["both"], initvals=begin, **sampling
            )
        return cls(settings, name, record, models, draws)

    def by_enkf(self, settings: Study, name: str) -> "Comparison":
        """Sample the same springs on the same record by an EnKF, started from these posteriors."""
        fewer = replace(settings, draws=max(200, settings.draws // ENKF_SHARE))
        models, draws = {}, {}
        for spring, known in self.draws.items():
            models[spring] = rival(spring, psf.EnKF(settings.particles), self.record)
            draws[spring] = fewer.sample(
                f"{name}-{spring}",
                models[spring],
                tune=ENKF_TUNE,
                pilot=known,
                compute_convergence_checks=False,
                **MOVED_NOISE,
            )
        return Comparison(settings, name, self.record, models, draws)

    def lead(self, spring: str) -> dict[str, float]:
        """Return a spring's lead in log-evidence over the other one of the `PAIR`, in nats."""
        pair = self.table.loc[[spring, *set(PAIR) - {spring}]]
        return {
            "lead": -float(np.diff(pair["log_evidence"])[0]),
            "se": float(np.hypot(*pair["se"])),
            "rhat": float(pair["rhat"].max()),
        }

    def moment(self) -> xr.DataArray:
        """Return the moment of the pitch spring in N m, averaged over the springs."""
        angle = xr.DataArray(ANGLES, dims="angle", coords={"angle": ANGLES})
        averaged = psf.average_models(
            self.draws,
            self.table,
            lambda posterior: pitch_moment(angle, posterior).rename("moment"),
            random_seed=self.seed,
        )
        return averaged["posterior"]["moment"]

    def peak(self) -> np.ndarray:
        """Return the averaged largest pitch in degrees within two seconds at `NEW_SPEED`."""
        inputs = np.append(self.record.speeds, np.full(NEW_STEPS, NEW_SPEED))

        def of(spring: str) -> xr.DataArray:
            future = psf.forecast(
                self.draws[spring],
                self.models[spring],
                n_steps=NEW_STEPS,
                inputs=inputs,
                n_draws=N_PATHS,
                random_seed=self.seed,
                extend_inferencedata=False,
                progressbar=False,
            )
            return largest_pitch(future["predictions"]["d_states"], "d_time").rename("peak")

        peaks = {spring: of(spring) for spring in self.models}
        functions = {spring: lambda _, of=peak: of for spring, peak in peaks.items()}
        averaged = psf.average_models(
            self.draws, self.table, functions, n_draws=N_PATHS, random_seed=self.seed
        )
        return averaged["posterior"]["peak"].values.ravel()


def _ends(draws: xr.DataTree, spring: str) -> list[dict[str, float]]:
    """Return the last points of a spring's chains as starts; parameters it lacks start small."""
    last = draws["posterior"].to_dataset().isel(draw=-1)
    return [
        {
            name: float(last[name][chain]) if name in last else 0.02 * SCALES[name]
            for name in COMMON + SPRINGS[spring]
        }
        for chain in range(last.sizes["chain"])
    ]


def largest_pitch(states: xr.DataArray, time: str) -> xr.DataArray:
    """Return the largest pitch in degrees in a path's second half, after the speed change."""
    pitch = np.rad2deg(states.sel(state="pitch"))
    return abs(pitch.isel({time: slice(NEW_STEPS // 2, None)})).max(time)


def true_peaks(name: str, record: Record) -> np.ndarray:
    """Return the same for the true system, under gusts with other seeds."""
    steps = record.speeds.size + np.arange(1, NEW_STEPS + 1)
    inputs = np.append(record.speeds, np.full(NEW_STEPS, NEW_SPEED))
    peaks = []
    for seed in range(N_PATHS // 4):
        made = psf.simulate(airfoil, TRUTHS[name], steps=steps, inputs=inputs, random_seed=seed)
        peaks.append(largest_pitch(made["states"][-NEW_STEPS:], "step"))
    return np.array(peaks)
