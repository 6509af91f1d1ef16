"""Fields of states, which are sums of terms with coefficients, at draws of the coefficients."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike

from ..errors import ModelError, ModelWarning, warn
from ..pymc_model.other_filter import model_of_draws
from ..pymc_model.posterior_draws import posterior_group
from ..system.checks import check_ci_prob, check_count, check_floats, check_random_seed
from ..system.gaussian_process_terms import GaussianProcessTerms
from ..system.term_library import TermLibrary
from .draws import SAMPLE_DIMS
from .estimation import smoothed_states
from .field_values import (
    Array,
    Terms,
    kernel_lengths,
    moments_of,
    paths_of,
    prior_draws,
    share_near,
    standard_deviation,
)

_N_POINTS = {1: 101, 2: 41, 3: 21}  # of the grid along each state
_N_JUDGED = 200  # visited states at which the field is compared with its prior
_MOST_OUTSIDE = 0.02  # of the visited states outside of the box
_MOST_TERMS = 200  # that are advised, about as many as have been tried
_SHORT = 0.1  # of the draws, with lengths that the terms cannot follow
_LEAST_TOLD = 0.9  # of the prior sd, above which the record has said next to nothing
_NAMES = {"mean", "sd", "low", "high", "prob_positive", "prior_sd", "near", "visited", "visit",
          "visited_state"}  # fmt: skip


def field(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    terms: Mapping[str, Terms],
    at: Mapping[str, ArrayLike] | None = None,
    ci_prob: float = 0.9,
    n_draws: int = 50,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> xr.DataTree:
    r"""Compute a field of the states from draws of its coefficients, and where the states were.

    The field is ``c @ basis(x)``, a sum of terms with a vector of coefficients; a minus sign with
    which it stands in the equation is not a part of it.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws from any sampler.
    model : pymc.Model, optional
        The model of the draws; by default that of the ``with`` block.
    terms : mapping of str to GaussianProcessTerms or TermLibrary
        The terms of each vector of coefficients, which is a variable or a Deterministic: ``{"c":
        basis}``. A library must have no parameters of its own.
    at : mapping of str to array_like, optional
        Values of each state, whose combinations are the points of the grid; a single value makes a
        slice. By default the box of the basis is divided evenly, or for a library the range in
        which the states were.
    ci_prob : float
        Probability of the band, between quantiles with equal tails.
    n_draws : int
        Number of draws at which states are smoothed, or all if there are fewer.
    random_seed : None, int or numpy.random.Generator
        Seed of the smoothed states, and of the draws from the prior.
    progressbar : bool
        Whether to show a progress bar if smoothing takes more than two seconds.

    Returns
    -------
    xarray.DataTree
        A group for each vector, of its name, with the states of its terms as dimensions and their
        values as coordinates:

        ``mean``, ``sd``, ``low``, ``high``
            Posterior mean and standard deviation of the field, and its band at each point.
        ``prob_positive``
            Probability that the field is positive.
        ``prior_sd``
            Standard deviation under the prior; NaN if this is improper.
        ``near``
            Share of the visited states near the point: in each state within `shortest_length` of a
            `GaussianProcessTerms`, or within a tenth of the range of a library's states. Where it
            is zero, the field is what the prior makes of its values elsewhere.
        ``visited``
            States at the times of the observations, drawn given all data; dims (visit,
            visited_state).

        The attribute ``doubts`` has what was warned of, and is empty if nothing was; ``ci_prob`` is
        the probability of the band.

    Raises
    ------
    ModelError
        If an argument is not as described, or idata lacks the coefficients.
    DataMismatchError
        If the draws are those of another model or of other data.

    Warns
    -----
    ModelWarning
        If states leave the boundary of the basis, or many its box; if the length of its kernel is
        shorter than its terms can follow; if the field is about as uncertain as before the record;
        or if no system has the states of the terms, so that there are no visited ones.

    See Also
    --------
    mechanics.gaussian_process_terms : Terms of a field whose form is unknown.
    plot_field : The picture.

    Examples
    --------
    A decay whose law is unknown. The field is the whole drift, and falls with the state:

    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> basis = psf.mechanics.gaussian_process_terms("z", (-0.5, 2.5), 6)
    >>> system = psf.StateSpaceModel(
    ...     states=["z"],
    ...     transition=lambda x, q, c: [x[0] + 0.1 * (c @ basis(x)) + 0.05 * q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[2.0],
    ...     initial_cov=[[0.01]],
    ...     shapes={"c": (len(basis),)},
    ... )
    >>> with pm.Model(coords={"term": basis.names}) as model:
    ...     c = pm.Normal("c", 0, basis.prior_sd(1.0, 2.0), dims="term")
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=range(40), observed=2 * np.exp(-0.1 * np.arange(40))
    ...     )
    ...     idata = psf.sample_dram(400, tune=600, random_seed=1, progressbar=False)
    >>> found = psf.field(idata, model, terms={"c": basis}, at={"z": [0.6, 1.5]}, random_seed=2)
    >>> found["c"]["prob_positive"].values.round(1)
    array([0., 0.])
    """
    check_ci_prob(ci_prob)
    rng = check_random_seed(random_seed)
    posterior = posterior_group(idata)
    _check_terms(terms)
    chosen = _checked_axes(at, terms)
    coefficients = {name: _coefficients(posterior, name, basis) for name, basis in terms.items()}
    model = model_of_draws(model, idata)
    n_draws = check_count("n_draws", n_draws, 1)
    smoothed = smoothed_states(
        idata, model, n_draws=min(n_draws, math.prod(posterior.sizes[dim] for dim in SAMPLE_DIMS)),
        random_seed=rng, extend_inferencedata=False, progressbar=progressbar,
    )["smoothed_states"].to_dataset()  # fmt: skip
    found = {}
    for name, basis in terms.items():
        paths = paths_of(smoothed, model, basis)
        visited = paths.reshape(-1, paths.shape[-1])
        visited = visited[np.isfinite(visited).all(axis=1)]
        axes = _axes(name, basis, chosen, visited)
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes.values(), indexing="ij")])
        prior = prior_draws(model, name, rng)
        moments = moments_of(coefficients[name], basis, grid, ci_prob)
        moments["prior_sd"] = standard_deviation(prior, basis, grid)
        moments["near"] = share_near(basis, grid, visited)
        shape = tuple(len(axis) for axis in axes.values())
        data = xr.Dataset(
            {key: (tuple(axes), values.reshape(shape)) for key, values in moments.items()},
            coords={**axes, "visited_state": list(basis.states)},
        )
        data["visited"] = ("visit", "visited_state"), visited
        judged = visited[np.linspace(0, len(visited) - 1, min(_N_JUDGED, len(visited))).astype(int)]
        doubts = [
            f"{name}: {doubt}"
            for doubt in (
                *_doubts(coefficients[name], prior, basis, paths, judged.T),
                *_doubts_of_lengths(basis, kernel_lengths(model, name, idata)),
            )
        ]
        for doubt in doubts:
            warn(doubt, ModelWarning)
        found[name] = data.assign_attrs(ci_prob=ci_prob, doubts="; ".join(doubts))
    return xr.DataTree.from_dict(found)


def _check_terms(terms: Any) -> None:
    if not isinstance(terms, Mapping) or not terms:
        raise ModelError(
            "terms must give the terms of each vector of coefficients, as {'c': basis}, got "
            f"{terms!r}"
        )
    for name, basis in terms.items():
        if not isinstance(basis, GaussianProcessTerms | TermLibrary):
            raise ModelError(
                f"terms must be of gaussian_process_terms or polynomial_terms, got {basis!r} for "
                f"{name!r}"
            )
        if isinstance(basis, TermLibrary) and basis.parameters:
            raise ModelError(
                f"terms must have no parameters of their own, got {list(basis.parameters)} in those"
                f" of {name!r}"
            )
        if taken := sorted(_NAMES & set(basis.states)):
            raise ModelError(
                f"states of terms must not have names of the result, got {taken} in those of "
                f"{name!r}: give them others"
            )


def _checked_axes(at: Any, terms: Mapping[str, Terms]) -> dict[str, Array]:
    """The values of each state that the user has given."""
    states = {state for basis in terms.values() for state in basis.states}
    given = {} if at is None else at
    if not isinstance(given, Mapping) or not set(given) <= states:
        raise ModelError(
            f"at must give values of the states {sorted(states)}, as "
            f"{{{min(states)!r}: np.linspace(-1, 1, 50)}}, got {at!r}"
        )
    axes = {
        state: np.atleast_1d(check_floats(f"at[{state!r}]", values, None))
        for state, values in given.items()
    }
    for state, axis in axes.items():
        if axis.ndim > 1 or not axis.size or (np.diff(axis) <= 0).any():
            raise ModelError(f"at[{state!r}] must have values that rise, got {given[state]!r}")
    return axes


def _coefficients(posterior: xr.Dataset, name: str, basis: Terms) -> Array:
    """The vector at all draws, (draws, terms)."""
    if name not in posterior:
        raise ModelError(
            f"idata must have draws of {name!r}, got a posterior with "
            f"{sorted(map(str, posterior.data_vars))}: where it is computed from others, make it a "
            "pm.Deterministic"
        )
    values = posterior[name].transpose(*SAMPLE_DIMS, ...).values
    if values.shape[2:] != (len(basis),):
        raise ModelError(
            f"{name!r} in idata must have the {len(basis)} coefficients of its terms, got shape "
            f"{values.shape[2:]}"
        )
    if not np.isfinite(values).all():
        raise ModelError(f"{name!r} in idata must be finite, got NaN or infinity in some draws")
    return np.asarray(values.reshape(-1, len(basis)), dtype=np.float64)


def _axes(name: str, basis: Terms, chosen: Mapping[str, Array], visited: Array) -> dict[str, Array]:
    """The values of each state in the grid."""
    if isinstance(basis, GaussianProcessTerms):
        box, (lowest, highest) = basis.box, basis.boundary.T
    else:
        lowest, highest = np.full((2, len(basis.states)), [[-np.inf], [np.inf]])
        box = ()
        if len(visited):
            box = tuple(zip(visited.min(axis=0), visited.max(axis=0), strict=True))
    if not box and (missing := [state for state in basis.states if state not in chosen]):
        raise ModelError(
            f"at must give values of {missing}, as no system has states of these names"
        )
    n = _N_POINTS.get(len(basis.states), 11)
    axes = {}
    for i, state in enumerate(basis.states):
        axes[state] = chosen[state] if state in chosen else np.linspace(*box[i], n)
        if axes[state][0] < lowest[i] or axes[state][-1] > highest[i]:
            raise ModelError(
                f"at[{state!r}] must lie within the boundary of the terms of {name!r}, "
                f"{lowest[i]:g} to {highest[i]:g}, beyond which they mean nothing, got "
                f"{axes[state][0]:g} to {axes[state][-1]:g}"
            )
    return axes


def _doubts(
    draws: Array, prior: Array | None, basis: Terms, paths: Array, judged: Array
) -> Iterator[str]:
    """Why the field may not be what it seems, given states (draws, rows, states) and a few."""
    if not paths.size:
        yield (
            f"where the states were is unknown, as no system has states of the names "
            f"{list(basis.states)} of the terms: StateSpaceModel(states=[...]) names them"
        )
        return
    if isinstance(basis, GaussianProcessTerms):
        low, high = basis.boundary.T
        beyond = ((paths < low) | (paths > high)).any(axis=(1, 2)).mean()
        low, high = np.transpose(basis.box)
        outside = ((paths < low) | (paths > high)).any(axis=2).mean()
        if beyond:
            yield (
                f"in {beyond:.0%} of the draws states leave the boundary of the terms, "
                f"{basis.boundary.round(3).tolist()}, beyond which the field is its mirror image "
                f"with the sign reversed: take {_wider(basis, paths)}"
            )
        elif outside > _MOST_OUTSIDE:
            yield (
                f"{outside:.0%} of the visited states lie outside of the box, "
                f"{[list(ends) for ends in basis.box]}, where the terms fall to zero, so that the "
                f"field is too small there and its band too narrow: take {_wider(basis, paths)}"
            )
    now, before = (
        np.linalg.norm(standard_deviation(each, basis, judged)) for each in (draws, prior)
    )
    ratio = now / before
    if ratio > _LEAST_TOLD:
        yield (
            f"where the states were, the field has {ratio:.0%} of its prior standard deviation: the"
            " record says next to nothing of it, so that the field is its prior. Noise hides it, or"
            f" the record is too short for {len(basis)} terms: measure longer, with a stronger "
            "excitation or less noise, or give the field a longer length"
        )


def _wider(basis: GaussianProcessTerms, paths: Array) -> str:
    """A box with all visited states (draws, rows, states), and sines as short as those of now.

    Without numbers where states are so far away that the sines would be too many.
    """
    low, high = np.transpose(basis.box)
    unit = 10 ** np.floor(np.log10(high - low) - 1)
    wide_low = np.minimum(low, np.floor(np.nanmin(paths, axis=(0, 1)) / unit) * unit)
    wide_high = np.maximum(high, np.ceil(np.nanmax(paths, axis=(0, 1)) / unit) * unit)
    n = np.ceil(basis.n * (wide_high - wide_low) / (high - low) - 1e-9)
    if not n.prod() <= _MOST_TERMS:
        return "a wider box, with as many more sines"
    box = [[float(f"{end:.6g}") for end in ends] for ends in zip(wide_low, wide_high, strict=True)]
    return f"the box {box}, with n={n.astype(int).tolist()} sines"


def _doubts_of_lengths(basis: Terms, lengths: Array | None) -> Iterator[str]:
    """Whether the draws have lengths of the kernel (draws, states) that the terms cannot follow."""
    if lengths is None or not isinstance(basis, GaussianProcessTerms):
        return
    shortest = basis.shortest_length
    share = (lengths < shortest).any(axis=1).mean()
    if share > _SHORT:
        needed = np.ceil(basis.n * np.maximum(shortest / np.quantile(lengths, 0.05, axis=0), 1))
        more = f"n={needed.astype(int).tolist()}, or " if needed.prod() <= _MOST_TERMS else ""
        yield (
            f"in {share:.0%} of the draws the length of the kernel is below "
            f"{shortest.round(3).tolist()}, the shortest that {list(basis.n)} sines can follow, so "
            f"that the field is smoother than these lengths say: take {more}a prior of the length "
            "that begins there"
        )
