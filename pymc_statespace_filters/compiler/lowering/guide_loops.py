"""Loops of a guide over the steps between two observations, for n states and m noises.

Sizes are constants of the machine code, so that the inner loops are unrolled and small vectors stay
in registers: a step there and back takes 60 ns, where calls of general code took 370 ns. Each loop
is an entry point, as the functions of a system are.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, types

from ..codegen.arguments import FOLLOW_ARGUMENTS, LOOK_BACK_ARGUMENTS, MemberArguments
from ..codegen.functions import vector_function
from ..codegen.machine_code import INT, Module, ModuleEntryPoint
from ..native.entry_point import EntryPoint, call_address
from ..native.jit import inline_always
from .guidance import n_gains, smoothed_cov, step_back, step_size

# Of the loop, which is told what it calls at every step.
LOOP_ARGUMENTS = {**FOLLOW_ARGUMENTS, "linearize": types.intp}


def follow_loop(smooth: Any, n: int, m: int) -> Callable:
    """Follow the gains from step ``first`` to ``last`` and linearise every step on the way.

    ``linearize`` is the address of the system's function, so that the loop is compiled once for all
    systems of these sizes.

    The linearised step is a mean over the points x and x +- sqrt(scale) L e_a, L L^T the covariance
    around the path. With a scale of 3 means of polynomials of the fifth degree in one state are
    exact; more than three states need a larger one, with which no weight is negative.
    """
    n_means, n_cov, n_points = n + n * n + n * m, n * (n + 1) // 2, 2 * n + 1
    n_step, n_row = step_size(n, m), 1 + n_gains(n, m)
    scale = float(max(3, n))
    take_root, residual_cov = _lower_root(n), _residual_cov(n, m, scale)
    reach, weight, at_centre = math.sqrt(scale), 0.5 / scale, 1.0 - n / scale

    def follow(c, inputs, first, last, t0, dt, path, gains, steps, cov, linearize):
        E, P = carray(path, (last + 1, n)), carray(cov, (n_cov,))
        all_gains, all_steps = carray(gains, (last, n_row)), carray(steps, (last, n_step))
        root, X, results = np.zeros((n, n)), np.empty((n, n_points)), np.empty((n_means, n_points))
        for k in range(first, last):
            gain, step = all_gains[k], all_steps[k]
            for r in range(m):
                q = gain[1 + r]
                for a in range(n):
                    q -= gain[1 + m + r * n + a] * E[k, a]
                step[n_means + r] = q
            take_root(P, root)
            for a in range(n):
                X[a, 0] = E[k, a]
                for b in range(n):
                    X[a, 1 + b] = E[k, a] + reach * root[a, b]
                    X[a, 1 + n + b] = E[k, a] - reach * root[a, b]
            arguments = MemberArguments(
                c=c, inputs=inputs, k=k, t=t0 + k * dt, z=step[n_means:], width=np.int64(0), X=X,
                out=results, n_members=np.int64(n_points),
            )  # fmt: skip
            call_address(linearize, arguments)
            for i in range(n_means):
                total = 0.0
                for point in range(1, n_points):
                    total += results[i, point]
                step[i] = weight * total
                if at_centre != 0.0:
                    step[i] += at_centre * results[i, 0]
            for a in range(n):
                E[k + 1, a] = step[a]
            residual_cov(X, results, step)
            values = smooth(step, gain[1:], P)
            for i in range(n_cov):
                P[i] = values[i]

    return follow


def _lower_root(n: int) -> Any:
    """The function that writes the lower root of a covariance, given by its lower triangle.

    A direction without variance has a zero column.
    """

    @inline_always
    def write(triangle, root):
        place = 0
        for a in range(n):
            for b in range(a + 1):
                value = triangle[place]
                for i in range(b):
                    value -= root[a, i] * root[b, i]
                if a == b:
                    root[a, a] = math.sqrt(value) if value > 1e-12 * triangle[place] else 0.0
                else:
                    root[a, b] = value / root[b, b] if root[b, b] > 0.0 else 0.0
                place += 1

    return write


def _residual_cov(n: int, m: int, scale: float) -> Any:
    """The function that ends a linearised step with the covariance of what it leaves out.

    In the mean over points x +- sqrt(scale) L e_a, of the next states minus their linear equations.
    """
    n_points, first = 2 * n + 1, step_size(n, m) - n * (n + 1) // 2
    weight = 0.5 / scale

    @inline_always
    def write(X, results, step):
        place, residual = first, np.empty((n, n_points))
        for a in range(n):
            for point in range(1, n_points):
                value = results[a, point] - step[a]
                for b in range(n):
                    value -= step[n + a * n + b] * (X[b, point] - X[b, 0])
                residual[a, point] = value
            for b in range(a + 1):
                total = 0.0
                for point in range(1, n_points):
                    total += residual[a, point] * residual[b, point]
                step[place] = weight * total
                place += 1

    return write


def look_back_loop(step_back: Any, n: int, m: int) -> Callable:
    """Move psi from step ``last`` back to ``first`` and condition the noise on the way.

    Adds two numbers to ``sums``: how much log psi may be wrong by what the linear equations leave
    out, and the log of prior over guided density at the mode, q for the prior and z = 0 for the
    guide. If psi is not finite, it is forgotten and the step stays unguided.
    """
    n_psi, n_gain = n + n * (n + 1) // 2, n_gains(n, m)
    n_step, n_row = step_size(n, m), 1 + n_gain
    noise = n + n * n + n * m
    residual_cov = n_step - n * (n + 1) // 2

    def look_back(first, last, path, steps, gains, psi, sums):
        E, ahead = carray(path, ((last + 1) * n,)), carray(psi, (n_psi,))
        all_gains, all_steps = carray(gains, (last, n_row)), carray(steps, (last, n_step))
        totals = carray(sums, (2,))
        for k in range(last - 1, first - 1, -1):
            place = 0
            for a in range(n):
                for b in range(a + 1):
                    part = ahead[n + place] * all_steps[k, residual_cov + place]
                    totals[0] += 0.5 * part if a == b else part
                    place += 1
            values = step_back(all_steps[k], E[k * n : (k + 2) * n], ahead)
            gain, finite = all_gains[k], True
            for i in range(n_psi):
                ahead[i] = values[i]
                finite &= np.isfinite(values[i])
            for i in range(n_row):
                gain[i] = values[n_psi + i]
            if not (finite and np.isfinite(gain[0])):
                for i in range(n_psi):
                    ahead[i] = 0.0
                for i in range(n_row):
                    gain[i] = 0.0
                place = 1 + m + m * n
                for r in range(m):
                    gain[place] = 1.0
                    place += m - r
            totals[1] += gain[0]
            for r in range(m):
                totals[1] -= 0.5 * all_steps[k, noise + r] ** 2

    return look_back


@lru_cache(maxsize=256)
def follow(system: Any) -> EntryPoint:
    """The loop of a guide that linearises the steps of a system."""
    module = Module()
    builder, given = module.main(FOLLOW_ARGUMENTS)
    linearize = builder.ptrtoint(module.entry(system.linearized_step.entry), INT)
    module.call(builder, _follow_loop(system.n, system.m), [*given.values(), linearize])
    builder.ret_void()
    return ModuleEntryPoint(module.finished(), FOLLOW_ARGUMENTS, "follow")


@lru_cache
def _follow_loop(n: int, m: int) -> EntryPoint:
    smooth = vector_function("smoothed_cov", "step, gains, cov", smoothed_cov(n, m))
    loop = follow_loop(smooth.function, n, m)
    return EntryPoint(loop, LOOP_ARGUMENTS, "follow", (repr((n, m)), smooth.key))


@lru_cache
def look_back(n: int, m: int) -> EntryPoint:
    """The loop of a guide that goes back; none of its arithmetic is the system's."""
    back = vector_function("step_back", "step, path, psi", step_back(n, m))
    loop = look_back_loop(back.function, n, m)
    return EntryPoint(loop, LOOK_BACK_ARGUMENTS, "look_back", (repr((n, m)), back.key))
