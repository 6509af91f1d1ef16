"""Plot of the probabilities of terms, from `select_terms`."""

from typing import Any

import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import line_x, scatter_x

from ..errors import ModelError
from .picture import Mark
from .rows import OF_PROBABILITIES, decimals, ends, format_probability, picture_of_rows
from .shapes import interval

STYLE = {"color": "C0"}
NEEDED = {"inclusion", "inclusion_se", "prior_inclusion"}
N_ERRORS = 2


def plot_terms(
    found: xr.DataTree, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot the probability of every term with two standard errors, and its prior probability.

    The most probable term is on top. A probability above its prior speaks for a term, and the
    median-probability model has those above one half. How they depend on the width of the slabs is
    drawn by ``plot_prior_sensitivity(found["widths"].to_dataset())``.

    Parameters
    ----------
    found : xarray.DataTree
        The result of `select_terms`.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``prior``, ``interval``, ``point``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If `found` is something else.

    Examples
    --------
    >>> import xarray as xr
    >>> from pymc_statespace_filters import plot_terms
    >>> terms = xr.Dataset(
    ...     {
    ...         "inclusion": ("term", [0.98, 0.12]),
    ...         "inclusion_se": ("term", [0.002, 0.01]),
    ...         "prior_inclusion": ("term", [0.5, 0.5]),
    ...     },
    ...     coords={"term": ["k3", "c2"]},
    ... )
    >>> collection = plot_terms(xr.DataTree.from_dict({"terms": terms}))
    >>> collection.savefig("terms.png")  # doctest: +SKIP
    """
    terms = _terms(found)
    points = terms[["inclusion"]]
    error = N_ERRORS * terms["inclusion_se"]
    bounds = interval((points - error).clip(0, 1), (points + error).clip(0, 1))
    prior = terms[["prior_inclusion"]].rename(prior_inclusion="inclusion")
    return picture_of_rows(
        points,
        [
            Mark(ends, "prior", interval(prior, prior), {"color": "B3", "width": 2}, "prior"),
            Mark(line_x, "interval", bounds, {"width": 2, **STYLE}, "two standard errors"),
            Mark(scatter_x, "point", points, STYLE, "probability"),
        ],
        _text,
        [terms["inclusion"], terms["inclusion_se"]],
        limits=OF_PROBABILITIES,
        x="probability of the term",
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def _terms(found: xr.DataTree) -> xr.Dataset:
    """The terms, most probable first."""
    is_tree = isinstance(found, xr.DataTree) and "terms" in found.children
    if not is_tree or not set(found["terms"].data_vars) >= NEEDED:
        raise ModelError(
            f"found must be the result of select_terms, got {type(found).__name__}"
            + (f" with the groups {sorted(found.children)}" if is_tree else "")
        )
    terms = found["terms"].to_dataset()[sorted(NEEDED)]
    return terms.isel(term=(-terms["inclusion"]).argsort(kind="stable").values)


def _text(probability: float, error: float) -> str:
    if not 0.01 <= probability <= 0.99 or not error > 0:
        return format_probability(probability)
    return f"{probability:.{decimals(error)}f} ± {error:.{decimals(error)}f}"
