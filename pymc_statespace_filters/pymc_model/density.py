"""A model's log-density at many points, evaluated by machine code in threads.

The log-density is PyTensor's compiled function, called by its address. Each point comes with the
noise seeds of its estimate, so that the values depend neither on the order nor on the number of
threads. Other graphs of a model's variables are compiled here too.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor
from numpy.typing import NDArray
from pymc.logprob.basic import transformed_conditional_logp
from pymc.logprob.utils import replace_rvs_by_values
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..compiler.native.compilation import COMPILATION, undamaged_files, warning_filter
from ..compiler.native.rows import Rows
from ..errors import ModelError
from .graph_rewrites import smooth_filters, with_filter
from .inspection import check_observed, log_density_graph, noise_seeds
from .written_function import native_function

Array = NDArray[np.float64]


def compile_density(inputs: Sequence[Variable], outputs: Sequence[Variable], **options: Any) -> Any:
    """Compile a graph of many scalars by PyMC's compiler, under the lock of compilation.

    Where there is no C++ compiler, PyTensor fuses at most 32 operands, which is a limit of NumPy's
    functions and not of numba's, and warns of a larger set: a model of nine parameters has one.
    """
    with COMPILATION, undamaged_files(), warning_filter("ignore", "Loop fusion failed"):
        return compile_pymc(inputs, outputs, **options)


def compile_raveled(
    point: Mapping[str, np.ndarray],
    outputs: Sequence[Variable],
    variables: Sequence[TensorVariable],
    seeds: Mapping[str, TensorVariable] | None = None,
    further: Sequence[Variable] = (),
    *,
    with_gradient: bool = False,
    **options: Any,
) -> tuple[Any, NDArray[np.float64]]:
    """Compile graphs over the vector of all variables: the function, and the vector at a point.

    With the gradient, that of the first graph by the vector is a further result.

    The other arguments of the function are a seed for each shared one, which ``seeds`` has by the
    name of its StateSpace variable, and ``further``.
    """
    inputs = {seed: seed.type(f"{name}_seed_input") for name, seed in (seeds or {}).items()}
    graphs, joined = join_nonshared_inputs(point, outputs, variables, inputs)
    if with_gradient:
        graphs = [*graphs, pytensor.grad(graphs[0], joined)]
    arguments = [joined, *inputs.values(), *further]
    function = compile_density(arguments, graphs, **({"on_unused_input": "ignore"} | options))
    function.trust_input = True
    start = np.concatenate([np.ravel(point[v.name]) for v in variables], dtype=np.float64)
    return function, start


def check_free_variables(model: pm.Model) -> None:
    """Raise unless a model has free variables, all of them continuous, and none without data."""
    check_observed(model)
    if model.discrete_value_vars:
        names = [model.values_to_rvs[value].name for value in model.discrete_value_vars]
        raise ModelError(
            f"model must have continuous free variables only, got discrete {names}: "
            "marginalise them out of the likelihood first"
        )
    if not model.free_RVs:
        raise ModelError("model must have at least one free variable, got none")


class RowFunction:
    """A scalar function of a model's free variables, compiled over their flat vector.

    ``output`` is a scalar graph of the model's value variables; the noise seeds become arguments,
    in the order of the noisy variables ``seed_names``, whose seeds in the model are
    ``model_seeds``. ``calls`` leads from points (m, k) and their m seeds of each variable to the
    results (m, ...), those of the graphs ``extra`` with them; the gradient, if wanted, is the last.
    The variables of the graphs may be others, those of ``point``.
    """

    def __init__(
        self,
        model: pm.Model,
        output: TensorVariable,
        extra: Sequence[TensorVariable] = (),
        point: Mapping[TensorVariable, Array] | None = None,
        *,
        with_gradient: bool = False,
    ) -> None:
        shared = noise_seeds(model)
        self.seed_names = tuple(shared)
        self.model_seeds = np.array([seed.get_value() for seed in shared.values()], dtype=np.int64)
        if point is None:
            values = [model.rvs_to_values[rv] for rv in model.free_RVs]
            start = model.initial_point()
        else:
            values, start = list(point), {value.name: at for value, at in point.items()}
        function, vector = compile_raveled(
            start, [output, *extra], values, shared, with_gradient=with_gradient
        )
        example = [vector, *self.model_seeds]
        self.calls = Rows(native_function(function, example), len(example))

    def evaluate(self, x: Array, seeds: NDArray[np.int64] | None = None) -> Array:
        """Evaluate points x (m, k), each with its row of seeds (m, n_seeds); NaN becomes -inf.

        Without `seeds` every point gets the seeds of the model.
        """
        if seeds is None:
            seeds = np.broadcast_to(self.model_seeds, (len(x), self.model_seeds.size))
        values = self.calls(x, *seeds.T)[0]
        return np.where(np.isnan(values), -np.inf, values)

    def fresh_seeds(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Seeds of independent noise, a row for each of so many points."""
        return rng.integers(np.iinfo(np.int64).max, size=(count, len(self.seed_names)))

    def evaluate_afresh(self, x: Array, rng: np.random.Generator) -> Array:
        """As `evaluate`, with fresh noise at every point."""
        return self.evaluate(x, self.fresh_seeds(len(x), rng))


class ModelDensity(RowFunction):
    """The compiled log-density of a model.

    ``moved`` is whether the chain moved its noise (``correlation``), with the smooth versions of
    the filters.
    """

    def __init__(self, model: pm.Model, *, moved: bool = False) -> None:
        check_free_variables(model)
        self.model = model
        self.moved = moved
        graph = log_density_graph(model)
        if moved:
            (graph,) = with_filter([graph], model, smooth_filters(model))
        super().__init__(model, graph)


class ConstrainedDensity(RowFunction):
    """The log-density of a model's variables as they are, in the order of ``point``, an example.

    No transform leaves out a part of their support, as an ordering does.
    """

    def __init__(self, model: pm.Model, point: Mapping[str, Array]) -> None:
        free = {rv: rv.type(name=rv.name) for rv in model.free_RVs}
        settings: dict[str, Any] = {
            "rvs_to_values": model.rvs_to_values | free,
            "rvs_to_transforms": dict.fromkeys(model.basic_RVs),
        }
        terms = transformed_conditional_logp(model.basic_RVs, jacobian=False, **settings)
        terms += replace_rvs_by_values(model.potentials, **settings)
        by_name = {value.name: value for value in free.values()}
        example = {by_name[name]: at for name, at in point.items()}
        total: Any = sum(term.sum() for term in terms)
        super().__init__(model, total, point=example)
