"""Plot of a model average beside the individual models (thesis, Figs. 15, 19 and 23)."""

from collections.abc import Hashable
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_plots import PlotCollection
from arviz_plots.visuals import line_xy

from ..errors import ModelError
from .picture import Mark, along_models, picture, style_of_curve, titles_of, with_unit
from .rows import format_probability
from .shapes import BOUND, band, curve

AVERAGE = "average"
N_GRID = 512
BOLD = {"color": "B1", "linestyle": "C0", "width": 4}
ENDS = {"color": "B1", "linestyle": "C1", "width": 1.5}  # of the interval of the average
SIZE, SIZE_ALONE, PANELS_IN_LINE = (3.8, 2.8), (6.0, 3.0), 4  # inches of a panel
PROB_SHOWN = 1e-3  # models above this probability determine the x range of densities


def plot_average(
    average: xr.DataTree, *, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot a model average and the individual models.

    A curve (one dimension with numeric coordinates) is shown as mean and interval, a scalar as
    density; the densities of the models are multiplied by their weights and add up to that of the
    average. Other dimensions become panels. The bands are the intervals of the models, the dashed
    lines that of the average. The axes are named by the array that the function returned:
    ``attrs["long_name"]`` or else its name, and ``attrs["units"]``.

    Parameters
    ----------
    average : xarray.DataTree
        Result of `average_models`.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``. Kind and probability of the intervals are taken
        from ``arviz.rcParams`` too.
    **pc_kwargs
        For ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``curve``, ``band``, ``lower`` and ``upper``, or ``density``, along ``model``: the
        average first, then the models, drawn on top of it.

    Raises
    ------
    ModelError
        If `average` is not a result of `average_models`, or has several numeric dimensions.

    Examples
    --------
    >>> import arviz as az
    >>> import numpy as np
    >>> from pymc_statespace_filters import average_models, plot_average
    >>> rng = np.random.default_rng(1)
    >>> soft = az.from_dict({"posterior": {"k": rng.normal(2.0, 0.3, (4, 500))}})
    >>> stiff = az.from_dict({"posterior": {"k": rng.normal(4.0, 0.3, (4, 500))}})
    >>> average = average_models(
    ...     {"soft": soft, "stiff": stiff},
    ...     {"soft": 0.3, "stiff": 0.7},
    ...     lambda posterior: posterior["k"],
    ...     random_seed=2,
    ... )
    >>> collection = plot_average(average)
    >>> collection.savefig("stiffness.png")  # doctest: +SKIP
    """
    if not (isinstance(average, xr.DataTree) and {"posterior", "members"} <= set(average.children)):
        raise ModelError(f"average must be a DataTree of average_models, got {average!r}")
    mixture = average["posterior"].to_dataset().drop_vars("model")
    members = average["members"].to_dataset()
    (name,) = mixture.data_vars
    along = _numeric_dims(mixture[name])
    if len(along) > 1:
        raise ModelError(
            f"average must have at most one dimension with numbers, got {along}: give the others "
            "text coordinates, or select from them"
        )

    data = _means(members, mixture) if along else _densities(members)
    panels = [dim for dim in members[name].dims if dim not in ("model", "chain", "draw", *along)]
    probs = zip(members["model"].values, members["prob"].values, strict=True)
    key = {AVERAGE: AVERAGE} | {one: f"{one} ({format_probability(p)})" for one, p in probs}
    thin = [{**style_of_curve(i), "width": 1.5} for i in range(members.sizes["model"])]
    quantity = _axis_label(mixture[name])
    if along:
        below, above = _intervals(members, mixture)
        marks = [*below, Mark(curve, "curve", data, {}, key), *above]
        x, y = _axis_label(mixture[along[0]]), quantity
    else:
        marks, x, y = [Mark(line_xy, "density", data, {}, key)], quantity, "density"
    return picture(
        data,
        marks,
        x=x,
        y=y,
        title=titles_of(members, panels),
        cols=panels,
        size=SIZE if panels else SIZE_ALONE,
        in_line=PANELS_IN_LINE,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aesthetics=along_models([BOLD, *thin]),
    )


def _axis_label(array: xr.DataArray) -> str:
    """Return ``attrs["long_name"]`` or the name in words, with the unit if there is one."""
    label = array.attrs.get("long_name", str(array.name).replace("_", " "))
    return with_unit(label, array.attrs.get("units"))


def _intervals(members: xr.Dataset, mixture: xr.Dataset) -> tuple[list[Mark], list[Mark]]:
    """Intervals of the models as bands, and that of the average as two lines, as ArviZ sets them.

    The bands are below the curves, the lines above them.
    """
    of_members, of_average = (
        getattr(draws.azstats, rcParams["stats.ci_kind"])() for draws in (members, mixture)
    )
    kind = "HDI" if rcParams["stats.ci_kind"] == "hdi" else "interval"
    share = f"{100 * rcParams['stats.ci_prob']:g} % {kind} of"
    lines = [
        Mark(curve, end, of_average.sel({BOUND: end}).expand_dims(model=[AVERAGE]), ENDS, key)
        for end, key in (("lower", f"{share} the average"), ("upper", ""))
    ]
    return [Mark(band, "band", of_members, {"alpha": 0.2}, f"{share} a model")], lines


def _numeric_dims(array: xr.DataArray) -> list[Hashable]:
    return [
        dim
        for dim in array.dims
        if dim not in ("chain", "draw") and array[dim].dtype.kind in "iufM"
    ]


def _means(members: xr.Dataset, mixture: xr.Dataset) -> xr.Dataset:
    """Return the mean of the average, followed by those under each model."""
    of_average = mixture.azstats.mean().expand_dims(model=[AVERAGE])
    return xr.concat([of_average, members.azstats.mean().drop_vars("prob")], "model")


def _densities(members: xr.Dataset) -> xr.Dataset:
    """Return the density of the average, followed by the weighted densities of the models."""

    def weighted(x: np.ndarray, y: np.ndarray, prob: np.ndarray) -> np.ndarray:
        shown = x[prob >= min(PROB_SHOWN, prob.max())]
        grid = np.linspace(shown.min(), shown.max(), N_GRID)
        each = [
            weight * np.interp(grid, at, density, left=0, right=0)
            for at, density, weight in zip(x, y, prob, strict=True)
        ]
        return np.stack([[grid, density] for density in (np.sum(each, axis=0), *each)], axis=1)

    (kernel_densities,) = members.azstats.kde().data_vars.values()
    densities = xr.apply_ufunc(
        weighted,
        kernel_densities.sel(plot_axis="x", drop=True),
        kernel_densities.sel(plot_axis="y", drop=True),
        members["prob"],
        input_core_dims=[["model", "kde_dim"], ["model", "kde_dim"], ["model"]],
        output_core_dims=[["plot_axis", "model", "grid"]],
        exclude_dims={"model"},
        vectorize=True,
    )
    coords = {"plot_axis": ["x", "y"], "model": [AVERAGE, *members["model"].values]}
    return densities.assign_coords(coords).to_dataset(name=kernel_densities.name)
