"""The observation given the state: its density, its moments, and draws of it."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytensor
import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...system import distributions
from ...system.model import StateSpaceModel
from ...system.normal_below import log_probability
from ..codegen.array_fallback import array_code
from ..codegen.function_types import CompiledFunction, jit
from ..native.cache_key import key_of
from ..native.jit import copy_into
from ..numerics.small_cholesky import LOG_TWO_PI
from .symbols import SYMBOLS, call, observation_moments, symbols_of

# A pivot of a covariance that is smaller, relative to its variance, has no correct digit.
_ROUNDING = 4.0 * np.finfo(float).eps


def without_missing(
    datum: TensorVariable, mean: TensorVariable, cov: TensorVariable
) -> tuple[TensorVariable, TensorVariable, TensorVariable]:
    """Residual, covariance and indicator of what was seen; NaN in ``datum`` marks a missing one.

    A missing component gets residual 0 and an independent unit variance, so that it neither
    moves the state nor adds to a quadratic form or a log-determinant. The datum is replaced
    before it is used: a NaN multiplied by zero would survive in a gradient.
    """
    missing = pt.isnan(datum)
    residual = pt.switch(missing, 0.0, pt.switch(missing, 0.0, datum) - mean)
    either = missing[:, None] | missing[None, :]
    cov = pt.switch(either, np.eye(datum.type.shape[0]), cov)
    return residual, cov, 1.0 - pt.cast(missing, "float64")


def log_normal(
    residual: TensorVariable, cov: TensorVariable, seen: TensorVariable
) -> TensorVariable:
    """log N(residual; 0, cov) over the components with ``seen`` = 1; NaN if cov is not definite."""
    chol = cholesky(cov, lower=True)
    standardised = solve_triangular(chol, residual, lower=True, b_ndim=1)
    root = pt.diagonal(chol)
    if residual.type.shape != (1,):
        root = pt.where(root**2 > _ROUNDING * pt.diagonal(cov), root, np.nan)
    log_det = pt.sum(pt.log(root))
    return -0.5 * pt.sum(standardised**2) - log_det - 0.5 * LOG_TWO_PI * pt.sum(seen)


def observation_log_density(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable], *, is_complete: bool = False
) -> TensorVariable:
    """log p(d | x); Gaussian noise through D Gamma D^T at e = 0 (Eqs. 4.4, 4.12).

    Of an observation that ``is_complete`` no component is missing.
    """
    if system.equations.observation_logp is not None:
        return call(system.equations.observation_logp, system, symbols)
    mean, cov = observation_moments(system, symbols)
    if system.equations.censoring is not None:
        flags = call(system.equations.censoring, system, symbols)
        residual, cov, seen = without_missing(symbols["d"], mean, cov)
        return _log_of_independent(residual, pt.diagonal(cov), seen, flags)
    if is_complete:
        return log_normal(symbols["d"] - mean, cov, pt.ones(system.p))
    return log_normal(*without_missing(symbols["d"], mean, cov))


def _log_of_independent(
    residual: TensorVariable, variances: TensorVariable, seen: TensorVariable, flags: TensorVariable
) -> TensorVariable:
    """Sum of log N(residual; 0, variance), or of the log of the probability of a side."""
    sd = pt.sqrt(variances)
    measured = -0.5 * (residual**2 / variances + LOG_TWO_PI) - pt.log(sd)
    cut = log_probability(-flags * residual / sd)
    return pt.sum(seen * pt.switch(pt.eq(flags, 0.0), measured, cut))


def expected_observation(
    system: StateSpaceModel, given: Mapping[str, TensorVariable]
) -> TensorVariable:
    """``h(x, e = 0)`` of an observation function, or the means of the user's distributions."""
    if system.equations.observation_draw is None:
        return call(system.equations.observation, system, given)
    means = [_mean(variable) for variable in _distributions(system, given)]
    return pt.stack([pt.cast(value, "float64") for value in means])


def _mean(variable: TensorVariable) -> TensorVariable:
    from pymc.distributions.moments import mean  # the user has imported PyMC
    from pymc.exceptions import UndefinedMomentException

    try:
        return mean(variable)
    except (NotImplementedError, UndefinedMomentException) as error:
        raise ModelError(
            "noise=False needs the mean of every distribution in observation_dist, got "
            f"{variable.owner.op}, of which PyMC gives none; use noise=True"
        ) from error


def conditional_moments(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> tuple[TensorVariable, TensorVariable]:
    """E[d | x] and Cov[d | x]; noise inside a function is linearised at zero (Eq. 4.4)."""
    if system.equations.observation_draw is None:
        return observation_moments(system, symbols)
    means, variances = zip(*map(_moments_of, _distributions(system, symbols)), strict=True)
    return pt.stack(means), pt.diag(pt.stack(variances))


def unknown_moments(system: StateSpaceModel) -> list[str]:
    """Distributions of the observables whose moments are not in the table, by name."""
    variables = _distributions(system, {})
    return [str(v.owner.op) for v in variables if type(v.owner.op) not in distributions.SCALAR_LAWS]


def _moments_of(variable: TensorVariable) -> tuple[TensorVariable, TensorVariable]:
    op = variable.owner.op
    parameters = [pt.cast(v, "float64") for v in distributions.parameters_of(variable.owner)]
    expected, variance = distributions.SCALAR_LAWS[type(op)].moments(*parameters)
    return pt.as_tensor(expected), pt.as_tensor(variance)


def _distributions(
    system: StateSpaceModel, given: Mapping[str, TensorVariable]
) -> list[TensorVariable]:
    """The random variables that the user's function returned, one per observable."""
    graph = system.equations.observation_draw
    assert graph is not None
    draw = _drawn(graph, symbols_of(system) | dict(given), _generators(graph))
    return [_without_cast(variable) for variable in draw.owner.inputs]


def _generators(graph: FrozenFunctionGraph) -> list[Variable]:
    return [variable.type() for variable in graph.inputs[len(SYMBOLS) :]]


def _drawn(
    graph: FrozenFunctionGraph,
    symbols: Mapping[str, TensorVariable],
    generators: Sequence[Variable],
) -> TensorVariable:
    """The vector of the user's distributions, of which those of integers are behind a cast."""
    (draw,) = graph.bind([*(symbols[name] for name in SYMBOLS), *generators])
    return draw


def _without_cast(variable: TensorVariable) -> TensorVariable:
    """The random variable in a stack of numbers of one type."""
    while isinstance(variable.owner.op, Elemwise) and isinstance(
        variable.owner.op.scalar_op, ps.Cast
    ):
        (variable,) = variable.owner.inputs
    return variable


def distribution_sampler(system: StateSpaceModel, graph: FrozenFunctionGraph) -> CompiledFunction:
    """``observe(rng, functions, c, inputs, k, t, x, out)`` writes a draw of d given x (n, 1).

    It is that of the user's distributions by PyTensor's code, to out (p,). ``functions`` are not
    used.
    """
    no_noise = {"q": pt.zeros((system.m,)), "e": pt.zeros((system.r,))}
    symbols = symbols_of(system) | no_noise
    generators = _generators(graph)
    draw = _drawn(graph, symbols, generators)
    # A mutable generator is advanced in place; a copy would give the same draw every time.
    mutable = [pytensor.In(generator, mutable=True) for generator in generators]
    named = [symbols[name] for name in ("theta", "x", "u", "t")]
    code = array_code([*named, *mutable], [draw])
    draw_code, n_theta, n_inputs = code.function, system.n_theta, system.n_inputs
    no_inputs = np.zeros(0)
    copies = "rng, " * len(generators)
    source = (
        "def observe(rng, functions, c, inputs, k, t, x, out):\n"
        f"    u = {'inputs[k]' if n_inputs else 'no_inputs'}\n"
        "    (drawn,) = draw_code(c[:n_theta].copy(), x[:, 0].copy(), u, np.asarray(t), "
        f"{copies})\n"
        "    copy_into(out, drawn)\n"
    )
    namespace = {
        "np": np, "copy_into": copy_into, "draw_code": draw_code, "n_theta": n_theta,
        "no_inputs": no_inputs,
    }  # fmt: skip
    exec(compile(source, "<observe of a state-space system>", "exec"), namespace)
    return CompiledFunction(
        jit(namespace["observe"]), key_of(__name__, source + repr(n_theta), code.key)
    )
