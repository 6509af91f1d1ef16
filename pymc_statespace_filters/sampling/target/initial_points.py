"""Where chains start: the user's initial values, or draws from the prior.

PyMC starts all chains of a step method at one point, so that R-hat cannot detect a chain that has
not left its start. Draws from the prior, on the unconstrained space, disperse the starts. Their
spread is also all that is known of the scales of the variables before a chain has moved.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pymc.initial_point import make_initial_point_fn, make_initial_point_fns_per_chain
from pymc.model import Model
from pytensor.graph.basic import Variable

from ...errors import ModelError
from ...filters.outcomes import Failure
from ...pymc_model.ends_of_support import ends_of_support
from ...pymc_model.prior_draws import naming_what_fails
from .variables import RaveledVariables

N_DRAWS = 200
# Number of prior draws with finite log-density of which a chain starts at the best.
N_COMPARED = 10


class EvaluatedPoint(NamedTuple):
    """A point on the unconstrained space, and its `Evaluation` with these noise seeds."""

    position: np.ndarray
    seeds: np.ndarray
    log_density: float
    failure: int
    n_effective: float = np.inf
    log_screen: float = 0.0  # log-density of the screen, 0 without one


class StartDraws:
    """Draws from the prior, as candidates for starts and as a measure of scale.

    PyMC does not pass ``initvals`` to a step method. The user's choice is recognised by a start
    that differs from the model's initial point, ``default``, or by an ``initval`` in the model;
    values equal to the initial point are not recognised.

    ``draws`` (n, d) are the first batch; ``is_prior`` tells whether all priors can be drawn from.
    """

    def __init__(self, model: Model, raveled: RaveledVariables, default: Mapping[str, np.ndarray]):
        rvs = [model.values_to_rvs[v] for v in raveled.variables]
        self._has_initvals = any(model.rvs_to_initial_values[rv] is not None for rv in rvs)
        self._default = raveled.ravel(default)
        self._model, self._raveled, self.is_prior = model, raveled, True
        free = list(model.free_RVs)
        self._point = make_initial_point_fn(model=model, overrides=dict.fromkeys(free, "prior"))
        try:
            self.draws = self.batch(0)
        except NotImplementedError:
            self.is_prior = False
            self._point = make_initial_point_fn(model=model, jitter_rvs=set(free))
            self.draws = self.batch(0)

    def batch(self, index: int) -> np.ndarray:
        """Draw from the prior, on the unconstrained space: finite rows, shape (n, d), n <= N_DRAWS.

        The seeds are fixed, so that the draws depend on the model alone; the generator of a chain
        chooses among them. A prior that cannot be drawn from, such as a flat one, is replaced by
        the model's initial point plus U(-1, 1), as in PyMC's NUTS.
        """
        seeds = range(index * N_DRAWS, (index + 1) * N_DRAWS)
        with naming_what_fails(self._model):
            table = np.array([self._raveled.ravel(self._point(seed)) for seed in seeds])
        return table[np.isfinite(table).all(axis=1)]

    def candidates(self, start: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        """List candidates for a start: draws from the prior, then the point of user or model.

        Only that point if the user chose it.
        """
        if self._has_initvals or not np.array_equal(start, self._default):
            return [start]
        return [*rng.permutation(self.draws), start]

    @property
    def may_start(self) -> bool:
        """Whether chains may start at a posterior found from the draws, as the user gave none."""
        return self.is_prior and not self._has_initvals and len(self.draws) > 1

    def covariance(self) -> np.ndarray:
        """Give a first proposal covariance: the prior's variances times 2.38^2 / d, diagonal."""
        return np.diag(self.variances()) * 2.38**2 / self._default.size

    def variances(self) -> np.ndarray:
        """Variances of the draws, as `variances_of`, shape (d,)."""
        return variances_of(self.draws)


def variances_of(draws: np.ndarray) -> np.ndarray:
    """Variances of draws (n, d), 1 where that is not a positive number, shape (d,)."""
    variances = draws.var(axis=0) if len(draws) > 1 else np.ones(draws.shape[1])
    variances[~(np.isfinite(variances) & (variances > 0.0))] = 1.0
    return variances


def best_initial_point(
    candidates: Sequence[np.ndarray], evaluate: Callable[[np.ndarray], EvaluatedPoint]
) -> tuple[EvaluatedPoint, tuple[int, ...]]:
    """Take the best of the first few candidates with finite log-density.

    Far out in the prior an estimated likelihood varies widely, and a chain that starts at an
    overestimate is slow to leave it. The best of a few draws lies closer, and the starts of several
    chains are still dispersed. Also returns, for each evaluation made, 0 or its failure code.
    Raises `ModelError` if the log-density is minus infinity at all candidates.
    """
    failures: tuple[int, ...] = ()
    finite: list[EvaluatedPoint] = []
    for position in candidates:
        point = evaluate(position)
        failures = (*failures, point.failure)
        if point.log_density > -np.inf:
            finite.append(point)
        if len(finite) == N_COMPARED:
            break
    if finite:
        return max(finite, key=lambda point: point.log_density), failures
    tried = f", nor at {len(failures) - 1} draws from the prior" if len(failures) > 1 else ""
    failure = Failure.of(failures[-1])
    because = f" ({failure.message})" if failure else ""
    cure = f". {failure.cure}" if failure.cure else ""
    raise ModelError(
        f"the log-density is not finite at the start, {candidates[-1].tolist()} on the "
        f"unconstrained space{because}{tried}: give a start of finite log-density by initvals, or "
        f"by a pilot of sample_dram whose chains ended at such points{cure}"
    )


def chain_candidates(
    model: Model,
    raveled: RaveledVariables,
    prior_draws: StartDraws,
    initvals: Any,
    seeds: Sequence[np.random.SeedSequence],
    *,
    disperse: bool,
) -> list[Callable[[np.random.Generator], Sequence[np.ndarray]]]:
    """For each chain, a function from its generator to the candidates for its start.

    ``initvals`` are as in ``pm.sample``; without any, candidates are drawn from the prior to
    ``disperse`` the starts. Raises `ModelError` if the values do not fit the model.
    """
    check_initvals(model, initvals, len(seeds))
    points = make_initial_point_fns_per_chain(
        model=model, overrides=initvals, jitter_rvs=set(), chains=len(seeds)
    )
    disperse = disperse and initvals is None

    def candidates(start: np.ndarray, rng: np.random.Generator) -> Sequence[np.ndarray]:
        return prior_draws.candidates(start, rng) if disperse else [start]

    # Evaluated here, because chains would call PyMC's functions from several threads at once.
    starts = [
        point(int(seed.generate_state(1)[0])) for point, seed in zip(points, seeds, strict=True)
    ]
    is_common = initvals is None or isinstance(initvals, Mapping)
    each = [initvals] * len(seeds) if is_common else initvals
    for start, given in zip(starts, each, strict=True):
        check_in_support(model, start, given)
    return [partial(candidates, raveled.ravel(start)) for start in starts]


def check_initvals(model: Model, initvals: Any, chains: int) -> None:
    """Raise a `ModelError` unless values are None, a mapping or one for each chain, and fit."""
    is_common = initvals is None or isinstance(initvals, Mapping)
    if not is_common:
        if not isinstance(initvals, list | tuple):
            raise ModelError(
                f"initvals must be None, a mapping or a sequence of mappings, got {initvals!r}"
            )
        if len(initvals) != chains:
            raise ModelError(
                f"initvals must have one entry for each chain, got {len(initvals)} for "
                f"chains={chains}"
            )
    known = {name for v, rv in model.values_to_rvs.items() for name in (v.name, rv.name)}
    for given in [initvals] if is_common else initvals:
        if unknown := [str(name) for name in given or () if str(name) not in known]:
            raise ModelError(
                f"initvals must name free variables of the model, "
                f"{', '.join(rv.name for rv in model.free_RVs)}, got {unknown[0]!r}"
            )
        for name, value in (given or {}).items():
            _check_initial_value(model, str(name), value)


def check_in_support(
    model: Model, start: Mapping[str, np.ndarray], given: Mapping[Any, Any] | None
) -> None:
    """Raise where given values lie outside the support of their variables: ``start`` is not finite.

    ``start`` has the values on the unconstrained space, by the names of the value variables.
    """
    values = {str(name): value for name, value in (given or {}).items()}
    for rv in model.free_RVs:
        name = model.rvs_to_values[rv].name
        is_outside = ~np.isfinite(np.ravel(start[name]))
        value = values.get(rv.name, values.get(name, model.rvs_to_initial_values[rv]))
        if value is None or not is_outside.any():
            continue
        support = f"the support of its {rv.owner.op._print_name[0]} prior"
        if (ends := ends_of_support(rv, model)) is not None and np.isfinite(ends).any():
            lower, upper = (end[is_outside.argmax()] for end in ends)
            support += f", ({lower:g}, {upper:g})"
        given_value = value if isinstance(value, Variable) else np.asarray(value).tolist()
        raise ModelError(
            f"the initial value of {rv.name!r} must lie inside {support}, got {given_value!r}"
        )


def _check_initial_value(model: Model, name: str, value: Any) -> None:
    """Raise unless a value, if it is numbers, has the shape of its variable."""
    if isinstance(value, Variable):
        return
    if isinstance(value, str):
        if value not in ("support_point", "prior"):
            raise ModelError(
                f"initvals of {name!r} must be numbers, 'support_point' or 'prior', got {value!r}"
            )
        return
    pairs = model.values_to_rvs.items()
    types = {variable.name: variable.type for pair in pairs for variable in pair}
    expected, found = types[name].shape, np.shape(value)
    is_like = len(expected) == len(found) and all(
        e is None or e == f for e, f in zip(expected, found, strict=True)
    )
    if not is_like:
        raise ModelError(f"initvals of {name!r} must have shape {expected}, got {found}")
