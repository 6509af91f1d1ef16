"""Pages of the reference, one per public name, written before each build."""

import inspect
import shutil
from collections.abc import Sequence
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

import pymc_statespace_filters as psf

PACKAGE = psf.__name__

# In the order of use. A public name that is missing here stops the build.
GROUPS = {
    "Systems": (
        "StateSpaceModel",
        "EulerMaruyama",
        "SemiImplicitEuler",
        "Milstein",
        "RungeKutta4",
        "LocalLinearization",
        "ExactLinear",
        "drifting",
        "RandomWalk",
        "OrnsteinUhlenbeck",
    ),
    "Parts of mechanical systems": (
        "mechanics.second_order",
        "mechanics.cubic",
        "mechanics.freeplay",
        "mechanics.hysteresis",
        "mechanics.hysteresis_branch",
        "mechanics.polynomial_terms",
        "mechanics.gaussian_process_terms",
    ),
    "Parts of Markov chains": ("system.stationary",),
    "Parts of compartment models": (
        "compartments.euler_multinomial",
        "compartments.gamma_white_noise",
    ),
    "Pharmacometrics": (
        "pharmacometrics.read_events",
        "pharmacometrics.normal_error",
        "pharmacometrics.log_normal_error",
    ),
    "Filters": (
        "EKF",
        "UKF",
        "IPLF",
        "FiniteStateFilter",
        "GridFilter",
        "IMM",
        "RBPF",
        "GuidedPF",
        "BootstrapPF",
        "EnKF",
        "PFEnKF",
    ),
    "Data and simulation, without PyMC": (
        "nearest_steps",
        "panel_from",
        "simulate",
        "log_likelihood",
        "run_filter",
        "online",
    ),
    "In a PyMC model": (
        "StateSpace",
        "sample",
        "sample_dram",
        "sample_smc",
        "extend",
        "DRAM",
        "find_starts",
        "suggest_particles",
        "run_models",
        "maximum_likelihood",
        "point_estimation.MaximumLikelihoodEstimate",
    ),
    "States, forecasts, diagnostics": (
        "filtered_states",
        "smoothed_states",
        "forecast",
        "free_run",
        "field",
        "filter_diagnostics",
        "diagnostics.drift_scan",
        "check_filter",
        "compute_log_likelihood",
        "leave_future_out",
    ),
    "Evidence and model choice": (
        "estimate_evidence",
        "compare_evidence",
        "average_models",
        "prior_sensitivity",
        "drift_evidence",
        "select_terms",
        "step_error",
        "reweight",
        "chib_jeliazkov",
        "evidence.Evidence",
    ),
    "Before the experiment": ("expected_information", "identifiability"),
    "Plots": (
        "plot_states",
        "plot_field",
        "plot_forecast",
        "plot_residuals",
        "plot_filter_health",
        "plot_drift",
        "plot_evidence",
        "plot_model_probabilities",
        "plot_prequential",
        "plot_prior_sensitivity",
        "plot_terms",
        "plot_designs",
        "plot_average",
    ),
    "Errors and warnings": (
        "errors.StateSpaceFiltersError",
        "errors.ModelError",
        "errors.DataMismatchError",
        "errors.GradientUnavailableError",
        "errors.LoweringError",
        "errors.CheckpointError",
        "errors.ParallelError",
        "errors.ModelWarning",
        "errors.FilterWarning",
        "errors.EvidenceWarning",
        "errors.CheckpointWarning",
        "errors.ParallelWarning",
    ),
}

# Members that a user calls. The others are for other packages here, or for PyMC (of a step method).
MEMBERS = {
    "evidence.Evidence": "prior_note",
    "point_estimation.MaximumLikelihoodEstimate": "summary",
    "PFEnKF": "density_method",
    "StateSpace": "dist",
}


def write(folder: Path) -> None:
    """Write an index of all names in groups, and one page for each name."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if missing := public_names() - {
        name for names in GROUPS.values() for name in names
    }:
        raise LookupError(f"not in GROUPS: {sorted(missing)}")
    for title, names in GROUPS.items():
        (folder / f"{_slug(title)}.rst").write_text(
            _group(title, names), encoding="utf-8"
        )
        for name in names:
            (folder / f"{name}.rst").write_text(_page(name), encoding="utf-8")
    (folder / "index.rst").write_text(_index(), encoding="utf-8")


def public_names() -> set[str]:
    """Names at the top level and in its modules, as ``EKF`` and ``mechanics.cubic``."""
    names = set()
    for name in psf.__all__:
        value = getattr(psf, name)
        if inspect.ismodule(value):
            names |= {f"{name}.{part}" for part in value.__all__}
        else:
            names.add(name)
    return names


def _index() -> str:
    """All names on one page; in the sidebar, a page for each group."""
    sections = [
        _heading("API reference", "="),
        f".. currentmodule:: {PACKAGE}\n",
    ]
    for title, names in GROUPS.items():
        sections += [_heading(title, "-"), _table(names)]
    return "\n".join([*sections, _toctree([_slug(title) for title in GROUPS])])


def _group(title: str, names: tuple[str, ...]) -> str:
    heading = [_heading(title, "="), f".. currentmodule:: {PACKAGE}\n"]
    return "\n".join([*heading, _table(names), _toctree(names)])


def _slug(title: str) -> str:
    return "-".join(title.lower().replace(",", "").split())


def _table(names: tuple[str, ...]) -> str:
    return _directive("autosummary", "nosignatures", names)


def _toctree(pages: Sequence[str]) -> str:
    return _directive("toctree", "hidden", pages)


def _directive(name: str, option: str, entries: Sequence[str]) -> str:
    lines = [f".. {name}::", f"   :{option}:", ""]
    return "\n".join([*lines, *(f"   {entry}" for entry in entries), ""])


def _page(name: str) -> str:
    value = _value(name)
    kind = "autoclass" if inspect.isclass(value) else "autofunction"
    module, _, last = f"{PACKAGE}.{name}".rpartition(".")
    lines = [
        _heading(name, "="),
        f".. currentmodule:: {module}",
        "",
        f".. {kind}:: {last}",
    ]
    if name in MEMBERS:
        lines += [f"   :members: {MEMBERS[name]}"]
    if inspect.isclass(value) and issubclass(value, Exception):
        lines += ["   :show-inheritance:"]
    return "\n".join(lines) + "\n"


def _value(name: str) -> Any:
    module = name.rpartition(".")[0]
    if module:
        import_module(f"{PACKAGE}.{module}")
    return attrgetter(name)(psf)


def _heading(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}\n"
