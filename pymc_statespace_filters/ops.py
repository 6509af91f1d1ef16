"""The log-likelihood of a record as a PyTensor operation, and its derivative as another.

Both are pure: parameters, data and the noise seed are inputs, and equal inputs give equal outputs.
Nothing that matters is closed over, so that neither merging of equal nodes nor the cache of
machine code on disk can mix two data sets up.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import pytensor
import pytensor.tensor as pt
from pytensor.gradient import DisconnectedType, grad_not_implemented
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key

from pymc_statespace_filters.errors import GradientUnavailableError, ModelError
from pymc_statespace_filters.filters import Filter
from pymc_statespace_filters.lowering import Compiled, jit, key_of
from pymc_statespace_filters.model import StateSpaceModel

HEALTH_SIZE = 3

_INPUT_TYPES = (
    ("theta", "float64", 1),
    ("steps", "int64", 1),
    ("observed", "float64", 2),
    ("inputs", "float64", 2),
    ("t0", "float64", 0),
    ("seed", "int64", 0),
)


class LogLikelihood(Op):
    """log p(d_j | d_1 .. d_{j-1}) of every observation, and a record of the filter's health.

    Inputs: ``theta`` (k,), ``steps`` (J,), ``observed`` (J, p), ``inputs`` (steps, n_inputs),
    ``t0``, ``seed``. Outputs: terms (J,), and health (3,): smallest effective number of
    particles, code of the failure, index of the failing observation.
    """

    __props__ = ("system", "filter")
    gufunc_signature = "(k),(j),(j,p),(s,u),(),()->(j),(h)"

    def __init__(self, system: StateSpaceModel, filter: Filter) -> None:
        self.system = system
        self.filter = filter

    def __str__(self) -> str:
        # The default would print every equation of the system.
        return f"{type(self).__name__}{{{self.filter}}}"

    def make_node(self, *inputs: Any) -> Apply:
        """Apply to symbols or numbers; the names and types are in `_INPUT_TYPES`."""
        return Apply(self, _typed(inputs), [pt.dvector(), pt.dvector()])

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """As many terms as steps."""
        return [(input_shapes[1][0],), (HEALTH_SIZE,)]

    def perform(self, node: Apply, inputs: Sequence, output_storage: Sequence) -> None:
        """Evaluate in PyTensor's modes without numba: by the same machine code."""
        for cell, value in zip(output_storage, evaluator(self)(*inputs), strict=True):
            cell[0] = value

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Reverse-mode derivative by theta; raises for a filter whose likelihood has none."""
        if not self.filter.has_gradient:
            raise GradientUnavailableError(
                f"The likelihood by {self.filter} is a random estimate without a gradient, so "
                f"NUTS, HMC, nutpie and find_MAP cannot use it. Sample with "
                f"pm.sample(step=psf.DRAM()), or take psf.EKF() for a likelihood with a gradient."
            )
        terms_bar = cotangents[0]
        if isinstance(terms_bar.type, DisconnectedType):
            theta_bar = pt.zeros_like(inputs[0])
        else:
            theta_bar = LogLikelihoodGradient(self.system, self.filter)(*inputs, terms_bar)
        data_bars = [
            grad_not_implemented(self, i, variable, "only parameters have a gradient")
            for i, variable in enumerate(inputs[1:], start=1)
        ]
        return [theta_bar, *data_bars]


class LogLikelihoodGradient(Op):
    """Vector-Jacobian product of `LogLikelihood`: inputs and terms_bar (J,) -> theta_bar (k,)."""

    __props__ = ("system", "filter")
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(j)->(k)"

    __init__ = LogLikelihood.__init__
    __str__ = LogLikelihood.__str__

    def make_node(self, *inputs: Any) -> Apply:
        """Apply to the inputs of `LogLikelihood` and the cotangent of its terms."""
        terms_bar = pt.as_tensor(inputs[-1], dtype="float64")
        return Apply(self, [*_typed(inputs[:-1]), terms_bar], [pt.dvector()])

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """The shape of theta."""
        return [input_shapes[0]]

    def perform(self, node: Apply, inputs: Sequence, output_storage: Sequence) -> None:
        """Evaluate in PyTensor's modes without numba: by the same machine code."""
        (output_storage[0][0],) = evaluator(self)(*inputs)


def _typed(inputs: Sequence[Any]) -> list[Variable]:
    return [
        pt.as_tensor(value, dtype=dtype, ndim=ndim)
        if not isinstance(value, Variable)
        else _checked(value, name, dtype, ndim)
        for value, (name, dtype, ndim) in zip(inputs, _INPUT_TYPES, strict=True)
    ]


def _checked(value: Variable, name: str, dtype: str, ndim: int) -> Variable:
    if value.type.ndim != ndim:
        raise TypeError(f"{name} must have {ndim} dimensions, got {value.type}")
    return value if value.type.dtype == dtype else pt.cast(value, dtype)


@cache
def evaluator(op: Op) -> Any:
    """A compiled Python function of the operation's inputs; its machine code is cached on disk."""
    inputs = [pt.tensor(name, dtype=dtype, shape=(None,) * n) for name, dtype, n in _INPUT_TYPES]
    if isinstance(op, LogLikelihoodGradient):
        inputs.append(pt.dvector("terms_bar"))
    return pytensor.function(
        inputs, op(*inputs, return_list=True), mode="NUMBA", on_unused_input="ignore"
    )


def check_record(system: StateSpaceModel) -> Any:
    """Compile a check of what `pm.set_data` may have exchanged; a kernel reads on regardless."""
    n_inputs, last_row = system.n_inputs, int(system.observation_uses_inputs)

    @jit
    def check(steps, inputs):
        for j in range(steps.size):
            if steps[j] < 0 or (j > 0 and steps[j] <= steps[j - 1]):
                raise ModelError("steps must not be negative and must increase strictly")
        if n_inputs and inputs.shape[1] != n_inputs:
            raise ModelError("inputs must have one column for each input of the system")
        if n_inputs and steps.size and inputs.shape[0] < steps[-1] + last_row:
            raise ModelError("inputs has too few rows: row k holds during step k")

    return check


def _check_observed(system: StateSpaceModel) -> Any:
    p = system.p

    @jit
    def check(steps, observed):
        if observed.shape[0] != steps.size or observed.shape[1] != p:
            raise ModelError("observed must have a row for each step, a column for each observable")

    return check


def cache_key(system: StateSpaceModel, compiled: Compiled) -> str | None:
    """What the machine code of this file is made of, on top of a compiled function."""
    checked = (system.p, system.n_inputs, system.observation_uses_inputs)
    return key_of(f"checked for {checked}", compiled.key)


@cache
def _kernel(system: StateSpaceModel, filter: Filter) -> Compiled:
    return filter.compile(system)


@cache
def _gradient_kernel(system: StateSpaceModel, filter: Any) -> Compiled:
    return filter.compile_gradient(system)


# Kernels are given copies: constants and variables, C and Fortran order differ in type, and every
# combination of types would be compiled anew, which takes seconds where a copy takes nanoseconds.


@register_funcify_and_cache_key(LogLikelihood)
def _numba_log_likelihood(op: LogLikelihood, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = _kernel(op.system, op.filter)
    run = compiled.function
    check, check_observed = check_record(op.system), _check_observed(op.system)

    @numba_njit
    def log_likelihood(theta, steps, observed, inputs, t0, seed):
        check(steps, inputs)
        check_observed(steps, observed)
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            seed.item(),
        )

    return log_likelihood, cache_key(op.system, compiled)


@register_funcify_and_cache_key(LogLikelihoodGradient)
def _numba_gradient(op: LogLikelihoodGradient, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = _gradient_kernel(op.system, op.filter)
    run = compiled.function
    check, check_observed = check_record(op.system), _check_observed(op.system)

    @numba_njit
    def log_likelihood_gradient(theta, steps, observed, inputs, t0, seed, terms_bar):
        check(steps, inputs)
        check_observed(steps, observed)
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            seed.item(),
            terms_bar.copy(),
        )

    return log_likelihood_gradient, cache_key(op.system, compiled)
