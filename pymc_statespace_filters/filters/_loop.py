"""The loop of every ensemble filter: predict up to an observation, update, note the increment."""

import numpy as np

from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._failures import NONE
from pymc_statespace_filters.filters._random import INITIAL, PROCESS, fill_normals, padded


def filter_loop(machine, n_members, workspace, update):
    """Compile the evaluation of one filter on one system.

    Parameters
    ----------
    machine : lowered system
        The compiled functions ``prepare``, ``initialise`` and ``propagate`` and the sizes of the
        system.
    n_members : int
        Number of members (particles), N.
    workspace : njit function ``() -> tuple of arrays``
        Allocates what ``update`` needs and keeps from one observation to the next (weights), once
        an evaluation.
    update : njit function
        ``(c, inputs, k, t, d, seed, X, work) -> (increment, n_effective, failure)``.
        Replaces the forecast members X (n, N) by the analysis at step k and returns log p(d_j | d_1
        .. d_{j-1}).

    Returns
    -------
    njit function ``(theta, steps, observed, inputs, t0, seed) -> (terms, health)``
        ``terms`` (J,): the increments, 0 for a row that is wholly missing, -inf from a failing
        observation on. ``health`` (3,): smallest effective number of particles, failure code, index
        of the failing observation or -1.
    """
    n, m, dt = machine.n, machine.m, machine.dt
    width = padded(n_members)
    prepare, initialise, propagate = machine.prepare, machine.initialise, machine.propagate

    @pasted
    def predict(c, inputs, k, t, seed, Z, X):
        """One step of every member with its own noise (Eqs. 4.22 and 4.40)."""
        fill_normals(seed, PROCESS, k, Z)
        propagate(c, inputs, k, t, Z, X)

    @pasted
    def nothing_seen(d):
        for value in d:
            if not np.isnan(value):
                return False
        return True

    @compiled
    def run(theta, steps, observed, inputs, t0, seed):
        terms, health = np.empty(steps.size), np.empty(3)
        terms[:] = -np.inf
        health[0], health[1], health[2] = n_members, NONE, -1
        c = prepare(theta)
        work = workspace()
        X = np.empty((n, n_members))
        Z = np.empty((n, width))
        k = np.int64(0)  # typed, so that nothing is compiled twice
        fill_normals(seed, INITIAL, k, Z)
        initialise(c, Z, X)
        Z = np.empty((m, width))
        for j in range(steps.size):
            while k < steps[j]:
                predict(c, inputs, k, t0 + k * dt, seed, Z, X)
                k += 1
            d = observed[j]
            if nothing_seen(d):
                terms[j] = 0.0
                continue
            increment, n_effective, failure = update(c, inputs, k, t0 + k * dt, d, seed, X, work)
            health[0] = min(health[0], n_effective)
            if failure != NONE:
                health[1], health[2] = failure, j
                break
            terms[j] = increment
        return terms, health

    return run
