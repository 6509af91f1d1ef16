"""Plot of the expected information of designs, from `expected_information`."""

from typing import Any

import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection
from arviz_plots.visuals import line_x, scatter_x

from ..errors import ModelError
from ..system.checks import shortened
from .picture import Mark
from .rows import decimals, ends, picture_of_rows
from .shapes import interval

STYLE = {"color": "C0"}
NEEDED = ("information", "low", "high", "se")
N_ERRORS = 2


def plot_designs(
    table: pd.DataFrame, *, of: str | None = None, backend: str | None = None, **pc_kwargs: Any
) -> PlotCollection:
    """Plot the expected information of each design between its bounds, with two standard errors.

    Parameters
    ----------
    table : pandas.DataFrame
        The result of `expected_information`.
    of : str, optional
        The model about whose parameters the information is; by default that of several models is
        about which of them is true, and that of one about its parameters.
    backend : {"matplotlib", "plotly", "bokeh", "none"}, optional
        Default: ``arviz.rcParams["plot.backend"]``.
    **pc_kwargs
        Passed to ``arviz_plots.PlotCollection.wrap``.

    Returns
    -------
    arviz_plots.PlotCollection
        Visuals ``two_se``, ``bounds``, ``point``, ``text``, ``x_label``.

    Raises
    ------
    ModelError
        If `table` is something else, or has no model of this name.

    Examples
    --------
    >>> import pandas as pd
    >>> from pymc_statespace_filters import plot_designs
    >>> table = pd.DataFrame(
    ...     {"information": [0.5, 0.1], "low": [0.4, 0.1], "high": [0.6, 0.1], "se": [0.03, 0.02]},
    ...     index=pd.Index(["pushed", "at rest"], name="design"),
    ... )
    >>> collection = plot_designs(table)
    >>> collection.savefig("designs.png")  # doctest: +SKIP
    """
    data = _chosen(table, of)
    points, error = data[["information"]], N_ERRORS * data["se"]
    bounds = interval(*(data[[end]].rename({end: "information"}) for end in ("low", "high")))
    is_of_models = of is None and "decided" in table
    about = "which model is true" if is_of_models else f"the parameters{f' of {of}' if of else ''}"
    return picture_of_rows(
        points,
        [
            Mark(
                line_x, "two_se", interval(points - error, points + error),
                {"width": 2, **STYLE}, "two standard errors",
            ),
            Mark(ends, "bounds", bounds, {"width": 2, "color": "B3"}, "low and high"),
            Mark(scatter_x, "point", points, STYLE, "information"),
        ],
        lambda value, se: f"{value:.{decimals(se)}f} ± {se:.{decimals(se)}f}",
        [data["information"], data["se"]],
        x=f"expected information about {about} (nats)",
        backend=backend,
        pc_kwargs=pc_kwargs,
    )  # fmt: skip


def _chosen(table: pd.DataFrame, of: str | None) -> xr.Dataset:
    """The information by design, with bounds and errors."""
    if not (isinstance(table, pd.DataFrame) and set(NEEDED) <= set(table.columns)):
        raise ModelError(f"table must be one of expected_information, got {shortened(table)}")
    found = table[list(NEEDED)]
    if of is not None:
        ends = {"information": "", "low": "_low", "high": "_high", "se": "_se"}
        columns = {f"parameters{end}[{of}]": name for name, end in ends.items()}
        if not set(columns) <= set(table.columns):
            models = [c[11:-1] for c in table.columns if c.startswith("parameters[")]
            raise ModelError(f"of must be one of the models {models}, got {of!r}")
        found = table[list(columns)].rename(columns=columns)
    return pd.DataFrame(found).rename_axis("design").to_xarray()
