"""Covariances of a system and their lower square roots."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytensor.tensor as pt
from numba import carray, types
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from ..codegen.function_types import ParameterFunction, jit
from ..native.entry_point import F64_PTR, EntryPoint
from .staged import staged
from .symbols import call


def covariances(
    system: StateSpaceModel, merged_noise: FrozenFunctionGraph | None = None
) -> dict[str, FrozenFunctionGraph]:
    """Covariances whose square roots colour the noise; an integrator's noise is white."""
    graphs = dict(vars(system.equations))
    if not system.has_gaussian_start:
        graphs["initial_cov"] = None
    if merged_noise is not None:
        graphs["process_noise"] = merged_noise
    names = ("initial_cov", "process_noise", "observation_noise")
    return {name: graphs[name] for name in names if graphs[name] is not None}


def followed_by_square_roots(
    outputs: Sequence[TensorVariable],
    system: StateSpaceModel,
    given: TensorVariable,
    theta: TensorVariable,
    graphs: Mapping[str, FrozenFunctionGraph],
) -> ParameterFunction:
    """These vectors, then the lower square root of every covariance, as a function of ``given``.

    The parameters theta are a function of it too.
    """
    covs = [call(graph, system, {"theta": theta}) for graph in graphs.values()]
    flat = pt.concatenate([*outputs, *(cov.ravel() for cov in covs)])
    sizes = [cov.type.shape[0] for cov in covs]
    return staged("prepare", [given], flat, SQUARE_ROOT, sizes)


@jit
def semidefinite_cholesky(a):
    """Lower square root in place; a zero pivot gives a zero column, a negative one NaN.

    Covariances without spread in some direction are ordinary here: a known initial state, noise
    that acts on the velocity alone. Zero is relative to the variance of the component: one may be
    in pascals, the next in metres.
    """
    n = a.shape[0]
    variance = np.empty(n)
    for j in range(n):
        variance[j] = a[j, j]
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] ** 2
        if pivot < -1e-10 * abs(variance[j]) or not np.isfinite(pivot):
            a[:] = np.nan
            return
        root = np.sqrt(pivot) if pivot > 1e-14 * variance[j] else 0.0
        a[j, j] = root
        for i in range(j + 1, n):
            rest = a[i, j]
            for k in range(j):
                rest -= a[i, k] * a[j, k]
            if root > 0.0:
                a[i, j] = rest / root
            elif abs(rest) > 1e-7 * np.sqrt(variance[i] * variance[j]):
                a[:] = np.nan
                return
            else:
                a[i, j] = 0.0
        for i in range(j):
            a[i, j] = 0.0


def _take_root(a, size):
    semidefinite_cholesky(carray(a, (size, size)))


SQUARE_ROOT = EntryPoint(_take_root, {"a": F64_PTR, "size": types.intp}, "square_root")
"""`semidefinite_cholesky` of the matrix at an address, compiled once for all systems."""
