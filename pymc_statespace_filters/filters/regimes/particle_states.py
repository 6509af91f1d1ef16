"""Smoothed states of a Rao-Blackwellised particle filter, see `backward_simulation`."""

import numpy as np

from ...compiler.native.plan import RECORD, REQUEST, RESULTS, plan_entry
from ..calls import ALL_STEPS, OK, opened, single_record, wanted_rows
from ..ensemble.backward_simulation import n_paths_of
from ..ensemble.callbacks import run_observed
from ..ensemble.evaluation import layout_of
from ..ensemble.summaries import write_summaries
from ..outcomes import NONE
from ..plan import PLAN, read_system
from .backward_simulation import Mixtures, simulate_backward


def _smooth(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    (_, n_finite, order), settings = layout_of(call.plan)
    call.results[RESULTS.n_states] = order.size
    if call.request[REQUEST.sizes_only]:
        return status
    rows, n, N = wanted_rows(call), call.plan[PLAN.n], call.plan[PLAN.n_members]
    data = single_record(call, 0, 0, call.record[RECORD.n_rows])
    n_steps = data.steps[-1] if data.steps.size else np.int64(0)
    integers, stored = np.array([n, N]), np.empty((n_steps + 1) * (n + 1) * N)
    reals = np.full((3 * order.size + 1) * rows.size, np.nan)
    status, _, health = run_observed(call, plan, record, integers, stored)
    is_known = health[1] == NONE
    if is_known:
        system = read_system(call.plan, data.theta, data.inputs)
        mixtures = Mixtures(
            stored=stored.reshape((n_steps + 1, n + 1, N)), n_finite=n_finite, order=order,
            moves=call.plan[PLAN.moves], n_draws=int(settings[0]), c=system.c,
            inputs=system.inputs, t0=data.t0, dt=system.dt,
        )  # fmt: skip
        simulate_backward(mixtures, n_paths_of(N), call.request[REQUEST.draw_seed], rows, reals)
    write_summaries(call, reals, health, ALL_STEPS if is_known else 0)
    return status


SMOOTH_MIXTURE = plan_entry(_smooth, "rbpf_smoother")
"""Smoothed states, by paths drawn back through the particles of all steps."""
