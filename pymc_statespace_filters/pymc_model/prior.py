"""The prior of a model on its unconstrained space: support, log-density, draws; likelihood."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.distributions.continuous import FlatRV, HalfFlatRV
from pymc.distributions.multivariate import ICARRV
from pymc.pytensorf import compile as compile_pymc
from pytensor.gradient import NullTypeGradError
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.basic import UniformRV
from pytensor.tensor.variable import TensorVariable

from ..errors import GradientUnavailableError, ModelError
from .density import RowFunction, check_free_variables
from .elements import places_in_vector
from .inspection import log_density_graph
from .prior_draws import PriorDraws, naming_what_fails

_IMPROPER = (FlatRV, HalfFlatRV, ICARRV)  # PyMC's densities without a finite integral
_N_TRIED = 50  # draws to test whether a transform is invertible on the whole support
_MAX_REPEATED = 0.01  # share of draws; rounding repeats far fewer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Support:
    """The fields of `Evidence` of the same names, and the priors that a transform restricts."""

    log_volume: float
    uniform: str
    improper: str
    restricted: tuple[str, ...]

    @classmethod
    def of(cls, model: pm.Model, ordered: Collection[str] = ()) -> "Support":
        """Inspect the priors of a model's free variables.

        A transform may restrict those that are known to be ``ordered``.
        """
        widths = {rv.name: log_widths for rv in model.free_RVs for log_widths in _widths(rv, model)}
        restricted = [
            rv.name
            for rv in model.free_RVs
            if rv.name not in ordered and can_sample(rv, model) and is_restricted(rv, model)
        ]
        improper = [
            rv.name for rv in model.free_RVs if rv.name in restricted or not can_sample(rv, model)
        ]
        volume = float(sum(widths.values()))
        return cls(volume, ", ".join(widths), ", ".join(improper), tuple(restricted))

    def check(self) -> Iterator[str]:
        """Yield a reason for each kind of improper priors."""
        if self.restricted:
            yield (
                f"a transform leaves a part of the prior of {', '.join(self.restricted)}, which is "
                "not normalised: if it keeps an order of labels that may be exchanged, name all "
                "variables that have them, as exchangeable=['mean', 'P'], and all orders count; "
                "otherwise give a prior without it, as pm.Truncated"
            )
        others = [one for one in self.improper.split(", ") if one not in self.restricted]
        if any(others):
            yield (
                f"the prior of {', '.join(others)} is improper or not normalised, so that the "
                "evidence depends on the units of the parameters: give them proper priors"
            )


def is_improper(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether the density of a free variable is known not to integrate to one."""
    return not can_sample(rv, model) or is_restricted(rv, model)


def can_sample(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether a prior can be sampled; false for PyMC's improper distributions."""
    return not any(isinstance(op, _IMPROPER) for op in _operations(rv, model))


def _operations(rv: TensorVariable, model: pm.Model) -> Iterator[object]:
    """The operations in a variable's distribution, down to the other variables of the model."""
    others = {other for other in model.basic_RVs if other is not rv}
    pending: list[Variable] = [v for v in ancestors([rv], blockers=others) if v not in others]
    while pending:
        owner = pending.pop().owner
        if owner is not None:
            yield owner.op
            # A compound distribution holds its components in an inner graph.
            pending.extend(ancestors(getattr(owner.op, "inner_outputs", ())))


def is_restricted(rv: TensorVariable, model: pm.Model) -> bool:
    """Whether a transform excludes a part of the support, as an ordering does.

    The density is then restricted to a part of its support without being normalised, and random
    draws do not survive a round trip through the transform.
    """
    transform = model.rvs_to_transforms[rv]
    if transform is None:
        return False
    unconstrained = transform.forward(rv, *rv.owner.inputs)
    back = transform.backward(unconstrained, *rv.owner.inputs)
    try:
        # Too few calls to be worth machine code.
        draw = compile_pymc([], [rv, back], random_seed=0, mode="FAST_COMPILE")
        pairs = [draw() for _ in range(_N_TRIED)]
    except NotImplementedError:  # it, or a variable it depends on, cannot be sampled
        return False
    return not all(np.allclose(before, after, rtol=1e-4) for before, after in pairs)


def _widths(rv: TensorVariable, model: pm.Model) -> Iterator[float]:
    """Sum of the log widths of a prior, if it is Uniform with constant bounds."""
    if not isinstance(rv.owner.op, UniformRV):
        return
    bounds = rv.owner.op.dist_params(rv.owner)
    if set(ancestors(bounds)) & set(model.basic_RVs):
        return
    shape = model.eval_rv_shapes()[rv.name]
    lower, upper = (bound.eval(mode="FAST_COMPILE").astype(np.float64) for bound in bounds)
    yield float(np.log(np.broadcast_to(upper - lower, shape)).sum())


class ModelPrior:
    """The distribution of a model's free variables; Potentials belong to the likelihood."""

    def __init__(self, model: pm.Model) -> None:
        self._model, self._free = model, model.free_RVs

    def log_density(self, x: Array) -> Array:
        """Log-density of points x (m, k), Jacobians included; NaN becomes -inf."""
        return self._density.evaluate(x)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, k), in the order of `log_density`.

        Raises `ModelError` if a prior cannot be sampled, like ``pm.Flat``; if a transform excludes
        a part of the support, as an ordering does, so that the density is not that of the draws; if
        single values have a positive probability, as of ``pm.Censored``; or if draws are rounded to
        the edge of the support, where the transform is infinite.
        """
        model = self._model
        if improper := [rv.name for rv in self._free if not can_sample(rv, model)]:
            raise ModelError(
                f"the prior of {', '.join(improper)} is improper and cannot be sampled: "
                "give it a proper prior"
            )
        if restricted := [rv.name for rv in self._free if is_restricted(rv, model)]:
            raise ModelError(
                f"the prior of {', '.join(restricted)} cannot be sampled: its transform excludes "
                "a part of the distribution's support, and the density is not normalised"
            )
        try:
            with naming_what_fails(model):
                found = self._draws(count, rng)
        except NotImplementedError as error:
            raise ModelError(f"the prior cannot be sampled: {error}") from None
        if on_edge := int((~np.isfinite(found)).any(axis=-1).sum()):
            raise ModelError(
                f"{on_edge} of {count} draws of the prior are rounded to the edge of their "
                "support, where the transform is infinite: give the model a prior with less mass "
                "there"
            )
        self._check_no_atoms(found)
        return found

    def _check_no_atoms(self, draws: Array) -> None:
        """Raise if a variable takes single values with positive probability, as a clipped one."""
        places = places_in_vector(self._model)
        names = np.repeat(list(places), [at.size for at in places.values()])
        for name, column in zip(names, draws.T, strict=True):
            repeated = len(column) - len(np.unique(column))
            if repeated > _MAX_REPEATED * len(column):
                raise ModelError(
                    f"{repeated} of {len(column)} draws of the prior of {name} repeat a value: it "
                    "has single values of positive probability, as pm.Censored has, and no "
                    "density there; give it a prior with a density, such as pm.Truncated"
                )

    @cached_property
    def _density(self) -> RowFunction:
        density = RowFunction(self._model, log_density_graph(self._model, self._free))
        density.calls.is_shared = False
        return density

    @cached_property
    def _draws(self) -> PriorDraws:
        return PriorDraws(self._model, self._free)


class ModelFactors:
    """Log prior and log-likelihood of a model on its unconstrained space.

    The likelihood is everything in the model except the priors of the free variables, Potentials
    included. It is evaluated by itself: far out in a prior, its difference from the log-density has
    no digits. The Jacobians of the transforms belong to the prior.
    """

    def __init__(self, model: pm.Model) -> None:
        check_free_variables(model)
        self.prior, self._model = ModelPrior(model), model
        self._graph = log_density_graph(model, [*model.observed_RVs, *model.potentials])
        self.likelihood = RowFunction(model, self._graph)

    @property
    def is_noisy(self) -> bool:
        """Whether the likelihood is a random estimate."""
        return bool(self.likelihood.seed_names)

    def evaluate(self, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Log prior and log-likelihood of points x (m, k), each (m,); -inf instead of NaN.

        A noisy likelihood is estimated with fresh noise at every point.
        """
        return self.evaluate_with(x, self.likelihood.fresh_seeds(len(x), rng))

    def with_slopes(self) -> Callable[[Array], tuple[Array, Array]] | None:
        """A function that gives log-likelihoods (m,) and gradients (m, k) at points (m, k).

        None if the likelihood is noisy, or has no gradient.
        """
        if self.is_noisy:
            return None
        try:
            calls = RowFunction(self._model, self._graph, with_gradient=True).calls
        except (GradientUnavailableError, NotImplementedError, NullTypeGradError):
            return None

        def found(x: Array) -> tuple[Array, Array]:
            log_likelihood, slopes = calls(x)
            inside = np.isfinite(self.prior.log_density(x)) & np.isfinite(log_likelihood)
            return np.where(inside, log_likelihood, -np.inf), slopes

        return found

    def evaluate_with(self, x: Array, seeds: NDArray[np.int64]) -> tuple[Array, Array]:
        """The same with the noise of these seeds, a row for each point."""
        log_prior = self.prior.log_density(x)
        log_likelihood = self.likelihood.evaluate(x, seeds)
        inside = np.isfinite(log_prior) & np.isfinite(log_likelihood)
        return log_prior, np.where(inside, log_likelihood, -np.inf)
