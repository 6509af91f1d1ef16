"""Plot of a model average beside the individual models (thesis, Figs. 15, 19 and 23)."""

import math
from collections.abc import Hashable
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import rcParams
from arviz_base.labels import NoVarLabeller
from arviz_plots import PlotCollection
from arviz_plots.visuals import labelled_title, labelled_x, labelled_y, line_xy

from ..errors import ModelError
from .canvas import (
    BOUND,
    band,
    canvas,
    curve,
    format_probability,
    size_of_panels,
    style_of_curve,
    with_unit,
)
from .legend import add_legend

AVERAGE = "average"
AES = ["color", "linestyle", "width"]
N_GRID = 512
ENDS = {"width": 1.5, "linestyle": "C1"}  # of the interval of the average
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
    n_members = members.sizes["model"]
    styles = [style_of_curve(i) for i in range(n_members)]
    intervals = _legend_of_intervals() if along else {}
    n_panels = math.prod(members.sizes[dim] for dim in panels)
    collection = canvas(
        data,
        backend=backend,
        pc_kwargs=pc_kwargs,
        aes={name: ["model"] for name in AES},
        size=size_of_panels(n_panels),
        n_panels=n_panels,
        key=[*_labels_of_models(members).values(), *intervals],
        cols=panels,
        color=["B1", *(style["color"] for style in styles)],
        linestyle=["C0", *(style["linestyle"] for style in styles)],
        width=[4, *[1.5] * n_members],
    )
    if panels:
        collection.map(
            labelled_title, "title", ignore_aes="all", subset_info=True, labeller=NoVarLabeller()
        )
    if along:
        _draw_curves(collection, members, mixture)
    else:
        collection.map(line_xy, "density")
    quantity = _axis_label(mixture[name])
    labels = (_axis_label(mixture[along[0]]), quantity) if along else (quantity, "density")
    collection.map(labelled_x, "x_label", ignore_aes="all", text=labels[0])
    collection.map(labelled_y, "y_label", ignore_aes="all", text=labels[1])
    add_legend(collection, _legend_of_models(collection, members) | intervals)
    return collection


def _axis_label(array: xr.DataArray) -> str:
    """Return ``attrs["long_name"]`` or the name in words, with the unit if there is one."""
    label = array.attrs.get("long_name", str(array.name).replace("_", " "))
    return with_unit(label, array.attrs.get("units"))


def _draw_curves(collection: PlotCollection, members: xr.Dataset, mixture: xr.Dataset) -> None:
    """Draw means, intervals of the models as bands, and that of the average as two lines."""
    of_members, of_average = (
        getattr(draws.azstats, rcParams["stats.ci_kind"])() for draws in (members, mixture)
    )
    ignored = {"ignore_aes": {"width", "linestyle"}}
    collection.map(band, "band", data=of_members, alpha=0.2, **ignored)
    collection.map(curve, "curve")
    for end in ("lower", "upper"):
        ends = of_average.sel({BOUND: end}).expand_dims(model=[AVERAGE])
        collection.map(curve, end, data=ends, **ENDS, **ignored)


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


def _labels_of_models(members: xr.Dataset) -> dict[str, str]:
    """Return the entries of the average and of the models, these with their probabilities."""
    probs = zip(members["model"].values, members["prob"].values, strict=True)
    return {AVERAGE: AVERAGE} | {name: f"{name} ({format_probability(p)})" for name, p in probs}


def _legend_of_models(collection: PlotCollection, members: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Return the styles of the average and of the models."""
    return {
        label: dict(collection.get_aes_kwargs(AES, "mapping", {"model": name}))
        for name, label in _labels_of_models(members).items()
    }


def _legend_of_intervals() -> dict[str, dict[str, Any]]:
    """Return the styles of the intervals, whose kind and probability ArviZ sets."""
    kind = "HDI" if rcParams["stats.ci_kind"] == "hdi" else "interval"
    share = f"{100 * rcParams['stats.ci_prob']:g} %"
    return {
        f"{share} {kind} of the average": {"color": "B1", **ENDS},
        f"{share} {kind} of a model": {"color": "B3", "alpha": 0.4, "width": 8},
    }
