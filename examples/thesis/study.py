"""The common parts of the studies: the command line, chains, and a folder for the results."""

import argparse
import hashlib
import json
import logging
import math
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib
import matplotlib.pyplot as plt
import pandas as pd
import pymc as pm
import xarray as xr
from matplotlib.figure import Figure

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence import Evidence

matplotlib.use("Agg")
# A study reports in tables; PyMC would announce every chain.
logging.getLogger("pymc").setLevel(logging.ERROR)

CHAINS = 4


@dataclass(frozen=True)
class Study:
    """The settings of one run of a study.

    Attributes
    ----------
    out : Path
        The folder of the run; the next run resumes from its contents.
    draws : int
        Kept draws of one posterior, of all chains together.
    particles : int
        Members of an ensemble, or particles.
    seed : int
    quick : bool
        Whether this is the short form, which omits what takes long.
    """

    out: Path
    draws: int
    particles: int
    seed: int
    quick: bool

    def sampling(self, name: str) -> dict[str, Any]:
        """Return keyword arguments of `sample_dram` and `run_models`; `name` names the folder."""
        draws = -(-self.draws // CHAINS)
        return {
            "draws": draws,
            "tune": max(500, draws // 4),
            "chains": CHAINS,
            "random_seed": self.seed,
            "checkpoint": self.out / "chains" / name,
        }

    def sample(self, name: str, model: pm.Model, **changes: Any) -> xr.DataTree:
        """Sample a model by `psf.sample_dram`; `changes` override the arguments of `sampling`."""
        settings = self.sampling(name) | changes
        return _whole(psf.sample_dram(model=model, **settings), settings)

    def run_models(
        self, name: str, models: Mapping[str, pm.Model], **changes: Any
    ) -> dict[str, xr.DataTree]:
        """Sample several models by `psf.run_models`; otherwise as `sample`."""
        settings = self.sampling(name) | changes
        found = psf.run_models(models, sampler="dram", **settings)
        return {of: _whole(draws, settings) for of, draws in found.items()}

    def evidence(self, name: str, draws: xr.DataTree, model: pm.Model) -> Evidence:
        """Estimate an evidence, or read what an earlier run computed for the same draws."""

        def find() -> dict[str, Any]:
            with warnings.catch_warnings():
                # The result itself reports its doubts, in a table.
                warnings.simplefilter("ignore", psf.errors.EvidenceWarning)
                return asdict(psf.chib_jeliazkov(draws, model, random_seed=self.seed))

        return Evidence(**self.kept(name, draws, find))

    def kept(self, name: str, draws: xr.DataTree, find: Callable[[], Any]) -> Any:
        """Return what `find` returns, or its result for the same draws from an earlier run."""
        drawn = hashlib.sha256(draws["sample_stats"]["lp"].values.tobytes()).hexdigest()
        path = self.out / "evidence" / f"{name} {drawn[:8]}.json"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".part")
            unfinished.write_text(json.dumps(find()), encoding="utf-8")
            os.replace(unfinished, path)  # written as a whole, even if the run is interrupted
        return json.loads(path.read_text(encoding="utf-8"))

    def table(self, name: str, table: pd.DataFrame, digits: int = 2) -> None:
        """Write a table as CSV in full, and as Markdown with this many digits after the point."""
        table.to_csv(self.out / f"{name}.csv")
        cells = table.reset_index() if any(table.index.names) else table
        rows = [cells.columns, ["---"] * cells.shape[1]]
        rows += [[_cell(value, digits) for value in row] for row in cells.itertuples(index=False)]
        lines = ["| " + " | ".join(map(str, row)) + " |" for row in rows]
        (self.out / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def picture(self, name: str, figure: Figure) -> None:
        """Write a figure as PNG."""
        figure.savefig(self.out / f"{name}.png", dpi=110)
        plt.close(figure)


def _whole(draws: xr.DataTree, settings: Mapping[str, Any]) -> xr.DataTree:
    """Stop the study if Ctrl-C ended its chains: incomplete chains are not a result."""
    sizes = draws["posterior"].sizes if "posterior" in draws else {}
    if any(sizes.get(dim[:-1]) != settings[dim] for dim in ("chains", "draws")):
        raise SystemExit("The chains were interrupted; the same command goes on from here.")
    return draws


def mixing(draws: xr.DataTree) -> dict[str, float]:
    """Return the largest R-hat and the smallest effective sample size of all parameters."""
    return {
        "R-hat": float(az.rhat(draws["posterior"].to_dataset()).to_array().max()),
        "effective draws": float(az.ess(draws["posterior"].to_dataset()).to_array().min()),
    }


def check(claim: str, holds: bool) -> None:
    """Stop the study with the claim as the message if it does not hold."""
    if not holds:
        raise SystemExit(f"This should hold and does not: {claim}.")


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.{digits}f}"
    return str(value)


def study(
    description: str, name: str, *, draws: int, particles: int, quick: tuple[int, int]
) -> Study:
    """Return the settings from the command line.

    Parameters
    ----------
    description : str
        The docstring of the study; its first line is the help.
    name : str
        The study's folder.
    draws, particles : int
        The defaults, those of the thesis.
    quick : tuple of int
        Draws and particles of the short form.
    """
    parser = argparse.ArgumentParser(description=description.split("\n")[0])
    of_draws, of_particles = (
        f"{number} if not given, {short} with --quick"
        for number, short in zip((draws, particles), quick, strict=True)
    )
    parser.add_argument("--draws", type=_at_least(100), help=f"of all chains together; {of_draws}")
    parser.add_argument("--particles", type=_at_least(10), help=of_particles)
    parser.add_argument(
        "--seed", type=_at_least(0), default=1, help="of the computation, not the records"
    )
    parser.add_argument("--quick", action="store_true", help="a short form, for a first look")
    parser.add_argument("--out", type=Path, help="the folder of tables and pictures")
    args = parser.parse_args()
    default_draws, default_particles = quick if args.quick else (draws, particles)
    out = args.out or Path("out", "thesis-quick" if args.quick else "thesis", name)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"argument --out: {out} is no folder, nor can it be made ({error.strerror})")
    return Study(
        out,
        args.draws or default_draws,
        args.particles or default_particles,
        args.seed,
        args.quick,
    )


def _at_least(least: int) -> Callable[[str], int]:
    """Return a type of whole numbers for an argument parser."""

    def number(text: str) -> int:
        if not text.strip().lstrip("+-").isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least {least}")
        return int(text)

    return number
