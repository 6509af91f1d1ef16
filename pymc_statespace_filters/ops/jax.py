"""Likelihoods in graphs that PyTensor compiles with JAX.

JAX calls the machine code of the package on the processor, through Python. An evaluation is one
call for the value and one for the gradient, and so are all evaluations of a `jax.vmap` together.

This is the only module that imports JAX. It is imported when JAX is asked for, see `ops`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.experimental.buffer_callback import buffer_callback
from pytensor.link.jax.dispatch import jax_funcify

from ..errors import GradientUnavailableError, ModelError
from .base import HEALTH_SIZE
from .likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    TapedLogLikelihood,
    TapePullback,
    check_has_gradient,
)
from .many_points import gradients, values
from .signatures import POINTS

type Shapes = Sequence[tuple[int, ...]]


@jax_funcify.register(LogLikelihood)
def _likelihood(op: LogLikelihood, **_: Any) -> Callable:
    """Terms and health; JAX takes their derivative by theta from the machine code."""
    if op.form == POINTS:
        of_point = _likelihood(LogLikelihood(op.system, op.filter))
        return jax.vmap(of_point, in_axes=(0, *[None] * (len(op.arguments) - 1)))

    @jax.custom_vjp
    def likelihood(*inputs):
        n_rows = inputs[1].shape[0]
        return tuple(_on_host(partial(values, op), [(n_rows,), (HEALTH_SIZE,)], *inputs))

    def forward(*inputs):
        check_has_gradient(op)
        if any(given.perturbed for given in inputs[1:]):
            raise GradientUnavailableError(
                "The likelihood has a gradient by the parameters of the system only, not by its "
                "data, inputs or t0."
            )
        numbers = [given.value for given in inputs]
        return likelihood(*numbers), numbers

    def backward(numbers, cotangents):
        terms_bar, _ = cotangents
        if isinstance(terms_bar, SymbolicZero):
            theta_bar = jnp.zeros_like(numbers[0])
        else:
            theta_bar = _gradient(op.gradient())(*numbers, terms_bar)
        return theta_bar, *[None] * (len(numbers) - 1)

    # With `symbolic_zeros`, JAX says which inputs it takes a derivative by.
    likelihood.defvjp(forward, backward, symbolic_zeros=True)
    return likelihood


@jax_funcify.register(LogLikelihoodGradient)
def _gradient(op: LogLikelihoodGradient, **_: Any) -> Callable:
    def gradient(*inputs):
        return _on_host(partial(gradients, op), [inputs[0].shape], *inputs)[0]

    return gradient


# The length of a tape is not known when JAX compiles. The way back makes the forward pass again.


@jax_funcify.register(TapedLogLikelihood)
def _taped(op: TapedLogLikelihood, **_: Any) -> Callable:
    likelihood = _likelihood(LogLikelihood(op.system, op.filter, op.form))
    return lambda *inputs: (*likelihood(*inputs), jnp.empty((0, 0)))


@jax_funcify.register(TapePullback)
def _pullback(op: TapePullback, **_: Any) -> Callable:
    gradient = _gradient(LogLikelihoodGradient(op.system, op.filter, op.form))
    return lambda *inputs: gradient(*inputs[:-2], inputs[-1])


def _on_host(function: Callable, shapes: Shapes, *inputs: Any) -> Sequence[Any]:
    """Results of these shapes, by a function of NumPy arrays; a `jax.vmap` calls it once."""
    if not jax.config.jax_enable_x64:
        raise ModelError(
            "JAX computes in single precision here, which would lose digits of the likelihood; "
            "keep jax.config.update('jax_enable_x64', True), which PyTensor sets where "
            "pytensor.config.floatX is 'float64'"
        )
    results = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    return jax.lax.platform_dependent(
        *inputs, cpu=_in_place(function, results), default=_by_copies(function, results)
    )


def _in_place(function: Callable, results: Sequence[jax.ShapeDtypeStruct]) -> Callable:
    """The function in JAX on the processor, where it reads and writes the memory of JAX itself.

    `_by_copies` takes ten times as long. And JAX may make the copies in the threads that wait for
    them: with some releases, long arrays made chains in parallel wait for each other forever
    (github.com/jax-ml/jax/issues/24255).
    """

    def write(_, outputs, *inputs):
        values = function(*map(np.asarray, inputs))
        for output, value in zip(outputs, values, strict=True):
            np.asarray(output)[...] = value

    return buffer_callback(write, results, vmap_method="expand_dims")


def _by_copies(function: Callable, results: Sequence[jax.ShapeDtypeStruct]) -> Callable:
    """The function in JAX on a device with a memory of its own, a GPU."""

    def call(*inputs):
        return function(*map(np.asarray, inputs))

    return partial(jax.pure_callback, call, results, vmap_method="expand_dims")
