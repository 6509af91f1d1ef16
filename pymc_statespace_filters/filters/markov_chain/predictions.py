"""The law of every observation given those before it: a mixture over the predicted states."""

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import RECORD, REQUEST, plan_entry
from ..calls import ALL_STEPS, OK, opened, single_record
from ..outcomes import NONE
from ..plan import read_system
from ..point_mass.predictions import observations_at, unknown_laws, write_mixture
from .forward import forward_pass, rows_on_tape
from .machine import read_chain
from .states import read_forwards


@njit_internal
def _write_law(system, chain, record, j, weights, laws):
    """Write the law of an observation from the probabilities of the states before it."""
    k = record.steps[j]
    h, roots = observations_at(system, k, record.t0 + k * chain.dt, chain.X)
    write_mixture(weights, 1.0, 1, h, roots, record.observed[j], laws, j)


def _predictions(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    J = call.record[RECORD.n_rows]
    data, laws = single_record(call, 0, 0, J), unknown_laws(call)
    system = read_system(call.plan, data.theta, data.inputs)
    chain = read_chain(call.plan, data.theta, data.inputs)
    tape = np.empty((rows_on_tape(data.steps), chain.n_states))
    code, j = forward_pass(chain, data, np.empty(0), np.empty(J), tape)
    end, weights = ALL_STEPS if code == NONE else data.steps[int(j)], np.empty((J, chain.n_states))
    for j in range(read_forwards(chain, data, tape, data.steps, 0, end, False, weights)):
        _write_law(system, chain, data, j, weights[j], laws)
    return status


PREDICTIONS_OF_CHAIN = plan_entry(_predictions, "markov_chain_predictions")
