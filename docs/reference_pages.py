"""Pages of the reference, one per public name, written before each build."""

import inspect
import shutil
from pathlib import Path

import pymc_statespace_filters as psf

PACKAGE = psf.__name__

# The group of a name follows from its package; a package that is missing here stops the build.
GROUPS = {
    "Systems and records": ("system",),
    "Filters": ("filters", "evaluation"),
    "In a PyMC model": ("pymc_model", "sampling", "point_estimation"),
    "States, forecasts, diagnostics": ("states", "diagnostics"),
    "Evidence and model choice": ("evidence",),
    "Plots": ("plots",),
    "Errors and warnings": ("errors",),
}

# Members that a user calls. The others are for other packages here, or for PyMC (of a step method).
MEMBERS = {
    "DimensionCorrection": "log_prior",
    "Evidence": "prior_note",
    "MaximumLikelihoodEstimate": "summary",
    "PFEnKF": "density_method",
    "StateSpace": "dist",
}


def write(folder: Path) -> None:
    """Write an index of all names in groups, and one page for each name."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    groups = _grouped()
    for title, names in groups.items():
        (folder / f"{_slug(title)}.rst").write_text(
            _group(title, names), encoding="utf-8"
        )
        for name in names:
            (folder / f"{name}.rst").write_text(_page(name), encoding="utf-8")
    (folder / "index.rst").write_text(_index(groups), encoding="utf-8")


def _grouped() -> dict[str, list[str]]:
    titles = {
        package: title
        for title, packages in GROUPS.items()
        for package in packages
    }
    groups: dict[str, list[str]] = {title: [] for title in GROUPS}
    for name in psf.__all__:
        module = getattr(psf, name).__module__
        package = module.removeprefix(f"{PACKAGE}.").split(".")[0]
        groups[titles[package]].append(name)
    return {title: names for title, names in groups.items() if names}


def _index(groups: dict[str, list[str]]) -> str:
    """All names on one page; in the sidebar, a page for each group."""
    sections = [
        _heading("API reference", "="),
        f".. currentmodule:: {PACKAGE}\n",
    ]
    for title, names in groups.items():
        sections += [_heading(title, "-"), _table(names)]
    return "\n".join([*sections, _toctree([_slug(title) for title in groups])])


def _group(title: str, names: list[str]) -> str:
    heading = [_heading(title, "="), f".. currentmodule:: {PACKAGE}\n"]
    return "\n".join([*heading, _table(names), _toctree(names)])


def _slug(title: str) -> str:
    return "-".join(title.lower().replace(",", "").split())


def _table(names: list[str]) -> str:
    return _directive("autosummary", "nosignatures", names)


def _toctree(pages: list[str]) -> str:
    return _directive("toctree", "hidden", pages)


def _directive(name: str, option: str, entries: list[str]) -> str:
    lines = [f".. {name}::", f"   :{option}:", ""]
    return "\n".join([*lines, *(f"   {entry}" for entry in entries), ""])


def _page(name: str) -> str:
    value = getattr(psf, name)
    kind = "autoclass" if inspect.isclass(value) else "autofunction"
    lines = [
        _heading(name, "="),
        f".. currentmodule:: {PACKAGE}",
        "",
        f".. {kind}:: {name}",
    ]
    if name in MEMBERS:
        lines += [f"   :members: {MEMBERS[name]}"]
    if inspect.isclass(value) and issubclass(value, Exception):
        lines += ["   :show-inheritance:"]
    return "\n".join(lines) + "\n"


def _heading(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}\n"
