"""The filters: frozen settings, one file each.

A filter has the attributes ``noisy`` (its likelihood is an estimate that depends on a seed) and
``has_gradient``, and these methods: ``check(system)`` raises if it cannot treat the system,
``is_exact_for(system)`` says whether its likelihood, or the mean of its estimates, is the system's,
and ``compile(system)`` gives the machine code ``(theta, steps, observed, inputs, t0, noise) ->
(terms, health)``; ``noise`` is a seed and a vector of stored normals, which deterministic filters
do not read. ``compile_states(system, moment)`` gives the machine code of the states, ``(theta,
steps, observed, inputs, t0, seed, rows, draw_seed) -> (mean, sd, drawn, n_effective, health)``: at
the steps ``rows``, (R, n) each and (R,), given the observations before them ("predicted"), up to
them ("filtered") or all ("smoothed", in the way that ``smoothing_method(system)`` names). From a
failing observation on they are NaN. ``compile_run(system)`` gives the machine code of one run with
all that it knew, ``(theta, steps, observed, inputs, t0, seed, rows) -> (terms, health, mean, cov,
members, weights)``: terms and health are those of ``compile``, the others, (R, n), (R, n, n),
(R, N, n) and (R, N), hold at the steps ``rows``, given the observations up to them; N is 0 for a
filter without members. What only some filters have is a method of theirs: ``stored_noise`` of the
noisy ones, ``compile_batch``, and with a gradient ``compile_gradient``, ``compile_taped``,
``compile_reverse``.
"""

from pymc_statespace_filters.filters.bootstrap import BootstrapPF
from pymc_statespace_filters.filters.ekf import EKF
from pymc_statespace_filters.filters.enkf import EnKF
from pymc_statespace_filters.filters.grid import GridFilter
from pymc_statespace_filters.filters.outcomes import COLLAPSED, FAILURES
from pymc_statespace_filters.filters.pf_enkf import PFEnKF

type Filter = EKF | EnKF | BootstrapPF | PFEnKF | GridFilter

__all__ = [
    "COLLAPSED",
    "EKF",
    "FAILURES",
    "BootstrapPF",
    "EnKF",
    "Filter",
    "GridFilter",
    "PFEnKF",
]
