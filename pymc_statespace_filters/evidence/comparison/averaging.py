"""Bayesian model averaging: a mixture of draws by model probability (thesis, Eq. 3.8)."""

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.special import softmax

from ...errors import ModelError
from ...system.checks import check_count

N_NORMALS = 50_000
SAMPLE_DIMS = ("chain", "draw")

Array = NDArray[np.float64]
Function = Callable[[xr.Dataset], xr.DataArray]


def average_models(
    idatas: Mapping[str, xr.DataTree],
    weights: pd.DataFrame | Mapping[str, float],
    function: Function | Mapping[str, Function],
    *,
    n_draws: int = 4000,
    random_seed: int | np.random.Generator | None = None,
) -> xr.DataTree:
    """Average a quantity over models, weighted by their probabilities (thesis, Eq. 3.8).

    The average is a mixture of draws, not a weighted mean of curves: it includes the spread within
    the models and between them.

    Parameters
    ----------
    idatas : mapping of str to xarray.DataTree
        Posterior draws of each model, in the group ``posterior``.
    weights : pandas.DataFrame or mapping of str to float
        The table of `compare_evidence`, or one weight >= 0 for each model (normalised here). With
        the table, the probabilities are averaged over the errors of the log-evidences.
    function : callable, or mapping of str to callable
        Maps the posterior of a model to the quantity, with dims ``chain``, ``draw`` and others that
        are the same for all models; one function per model if their parameters differ. It may
        return fewer draws than the posterior has, as states or forecasts of some of them.
    n_draws : int
        Number of draws of the mixture.
    random_seed : None, int or numpy.random.Generator
        Seed.

    Returns
    -------
    xarray.DataTree
        ``posterior``
            The mixture, named like the arrays, else like the function, else ``average``. Dims chain
            (1), draw (`n_draws`) and those of the quantity; coordinate ``model`` (chain, draw): the
            model of each draw.
        ``members``
            The quantity under each model alone. Dims model, chain (1), draw (the same number for
            each, without repetition, at most `n_draws`) and those of the quantity; coordinate
            ``prob`` (model): the probability used in the mixture.

    Raises
    ------
    ModelError
        If an argument is invalid, an evidence in the table has no standard error, or the arrays of
        the models disagree in dims, shape or coordinates. An exception of `function` is passed on
        with a note that names the model.

    Notes
    -----
    The numbers of draws per model, and the draws within a model, are chosen systematically, evenly
    along the chains, and then shuffled. The order of the result has no autocorrelation: judge
    convergence by the original chains.

    Examples
    --------
    >>> import arviz as az
    >>> import numpy as np
    >>> import xarray as xr
    >>> from pymc_statespace_filters import average_models
    >>> rng = np.random.default_rng(1)
    >>> linear = az.from_dict({"posterior": {"k": rng.normal(2.0, 0.1, (4, 500))}})
    >>> cubic = az.from_dict({"posterior": {"c": rng.normal(0.5, 0.1, (4, 500))}})
    >>> x = xr.DataArray(np.linspace(-2, 2, 5), coords=[("x", np.linspace(-2, 2, 5))])
    >>> force = average_models(
    ...     {"linear": linear, "cubic": cubic},
    ...     {"linear": 0.25, "cubic": 0.75},
    ...     {"linear": lambda post: post["k"] * x, "cubic": lambda post: post["c"] * x**3},
    ...     random_seed=2,
    ... )
    >>> force["posterior"]["average"].sizes
    Frozen({'chain': 1, 'draw': 4000, 'x': 5})
    >>> force["posterior"]["average"].mean(["chain", "draw"]).round(1).values
    array([-4. , -0.9,  0. ,  0.9,  4. ])
    """
    names = _names(idatas)
    check_count("n_draws", n_draws, 1)
    rng = np.random.default_rng(random_seed)
    prob = _probabilities(weights, names, rng)
    arrays = _evaluate(idatas, function)
    samples = {name: _flat(array) for name, array in arrays.items()}

    counts = _systematic_counts(prob, n_draws, rng)
    chosen = [
        sample[_systematic_indices(len(sample), count, rng)]
        for sample, count in zip(samples.values(), counts, strict=True)
    ]
    origin = np.repeat(names, counts)
    order = rng.permutation(n_draws)
    n_alone = min(n_draws, *(len(sample) for sample in samples.values()))
    alone = np.stack(
        [sample[_systematic_indices(len(sample), n_alone, rng)] for sample in samples.values()]
    )

    label = _label(arrays, function)
    quantity = _without_samples(next(iter(arrays.values())))
    posterior = xr.Dataset(
        {
            label: (
                (*SAMPLE_DIMS, *quantity.dims),
                np.concatenate(chosen)[order][None],
                quantity.attrs,
            )
        },
        coords={"chain": [0], "draw": np.arange(n_draws), **quantity.coords},
    ).assign_coords(model=(SAMPLE_DIMS, origin[order][None]))
    members = xr.Dataset(
        {label: (("model", *SAMPLE_DIMS, *quantity.dims), alone[:, None])},
        coords={"model": names, "chain": [0], "draw": np.arange(n_alone), **quantity.coords},
    ).assign_coords(prob=("model", prob))
    return xr.DataTree.from_dict({"posterior": posterior, "members": members})


def _names(idatas: Mapping[str, xr.DataTree]) -> list[str]:
    if not isinstance(idatas, Mapping) or not idatas:
        raise ModelError(
            "idatas must be a mapping of model names to DataTree with at least one entry, "
            f"got {idatas!r}"
        )
    for name, idata in idatas.items():
        if not (isinstance(idata, xr.DataTree) and "posterior" in idata.children):
            raise ModelError(
                f"idatas[{name!r}] must be a DataTree with a group 'posterior', got {idata!r}"
            )
    return list(idatas)


def _probabilities(
    weights: pd.DataFrame | Mapping[str, float], names: list[str], rng: np.random.Generator
) -> Array:
    """Probabilities of the models; from a table, averaged over errors of the log-evidences."""
    if isinstance(weights, pd.DataFrame):
        if not {"prob", "se"} <= set(weights.columns):
            raise ModelError(
                "weights must have the columns 'prob' and 'se' of compare_evidence, "
                f"got {list(weights.columns)}"
            )
        given, se = _matched(weights["prob"], names), _matched(weights["se"], names)
        if np.isnan(se).any():
            raise ModelError(
                "weights must have a standard error for every model, got NaN for "
                f"{names[int(np.isnan(se).argmax())]!r}: pass dict(table['prob']) to ignore errors"
            )
    elif isinstance(weights, Mapping):
        given, se = _matched(weights, names), np.zeros(len(names))
    else:
        raise ModelError(
            "weights must be the table of compare_evidence or a mapping of model names to "
            f"numbers, got {weights!r}"
        )
    if not (np.isfinite(given).all() and (given >= 0).all() and given.sum() > 0):
        got = dict(zip(names, given.tolist(), strict=True))
        raise ModelError(f"weights must be finite and >= 0, one of them > 0, got {got}")
    if not se.any():
        return given / given.sum()
    with np.errstate(divide="ignore"):
        log_weight = np.log(given)
    errors = se * rng.standard_normal((N_NORMALS, len(names)))
    return softmax(log_weight + errors, axis=1).mean(axis=0)


def _matched(weights: pd.Series | Mapping[str, float], names: list[str]) -> Array:
    models = list(weights.keys())
    if len(models) != len(names) or set(models) != set(names):
        raise ModelError(f"weights must be given for exactly the models {names}, got {models}")
    return np.array([weights[name] for name in names], dtype=np.float64)


def _evaluate(
    idatas: Mapping[str, xr.DataTree], function: Function | Mapping[str, Function]
) -> dict[str, xr.DataArray]:
    """Compute the quantity under every model and check that dims and coordinates agree."""
    if isinstance(function, Mapping) and set(function) != set(idatas):
        raise ModelError(
            f"function must be given for exactly the models {list(idatas)}, got {list(function)}"
        )
    arrays = {}
    for name, idata in idatas.items():
        of_model = function[name] if isinstance(function, Mapping) else function
        if not callable(of_model):
            raise ModelError(f"function must be callable, got {of_model!r} for model {name!r}")
        try:
            array = of_model(idata["posterior"].to_dataset())
        except Exception as error:
            error.add_note(f"raised by function with the posterior of model {name!r}")
            raise
        if not (
            isinstance(array, xr.DataArray)
            and set(SAMPLE_DIMS) <= set(array.dims)
            and "model" not in {*array.dims, *array.coords}
        ):
            raise ModelError(
                "function must return a DataArray with dims 'chain' and 'draw' and without 'model',"
                f" got {array!r} for model {name!r}"
            )
        if not array.sizes["chain"] * array.sizes["draw"]:
            raise ModelError(f"function must return draws, got none for model {name!r}")
        arrays[name] = array

    first, reference = next(iter(arrays.items()))
    for name, array in arrays.items():
        difference = _difference(_without_samples(reference), _without_samples(array))
        if difference:
            raise ModelError(
                "function must return arrays of the same form for all models, got for "
                f"{first!r} and {name!r} {difference}"
            )
    dims = [dim for dim in reference.dims if dim not in SAMPLE_DIMS]
    return {name: array.transpose(*SAMPLE_DIMS, *dims) for name, array in arrays.items()}


def _difference(one: xr.DataArray, other: xr.DataArray) -> str:
    """Describe a difference of dims, sizes or coordinates; empty if there is none."""
    if set(one.dims) != set(other.dims):
        return f"arrays of different dims, {one.dims} and {other.dims}"
    for dim in one.dims:
        if one.sizes[dim] != other.sizes[dim]:
            return f"arrays of different length along {dim!r}, {one.sizes[dim]}, {other.sizes[dim]}"
        if (dim in one.coords) != (dim in other.coords) or not one[dim].equals(other[dim]):
            return f"arrays with different coordinates along {dim!r}"
    return ""


def _label(arrays: Mapping[str, xr.DataArray], function: Function | Mapping[str, Function]) -> str:
    """Name of the average: that of the arrays, else that of the function."""
    names = {array.name for array in arrays.values()}
    of_function = getattr(function, "__name__", "<mapping>")
    first = next(iter(arrays.values()))
    taken = {*first.coords, *first.dims, "model", "prob"}
    for label in (names.pop() if len(names) == 1 else None, of_function):
        if label and label not in taken and not str(label).startswith("<"):
            return str(label)
    return "average"


def _without_samples(array: xr.DataArray) -> xr.DataArray:
    of_samples = [name for name, coord in array.coords.items() if {*SAMPLE_DIMS} & {*coord.dims}]
    return array.drop_vars(of_samples).isel(chain=0, draw=0)


def _flat(array: xr.DataArray) -> NDArray:
    """Concatenate the draws of all chains."""
    return array.values.reshape(-1, *array.shape[2:])


def _systematic_counts(prob: Array, n_draws: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Number of draws per model: within one of n_draws times the probability."""
    edges = np.concatenate([[0.0], np.cumsum(prob)])
    return np.diff(np.floor(n_draws * edges / edges[-1] + rng.random())).astype(np.int64)


def _systematic_indices(
    n_available: int, n_wanted: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Choose draws evenly along the chains; the numbers of copies differ by one at most."""
    places = (np.arange(n_wanted) + rng.random()) * (n_available / max(n_wanted, 1))
    return np.minimum(places.astype(np.int64), n_available - 1)
