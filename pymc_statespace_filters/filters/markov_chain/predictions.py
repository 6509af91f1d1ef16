"""The law of every observation given those before it: a mixture over the predicted states."""

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import RECORD, REQUEST, RESULTS, plan_entry
from ..calls import OK, opened, reals_at, single_record
from ..outcomes import NONE
from ..plan import PLAN, read_system
from ..point_mass.predictions import Laws, forget, observations_at, write_mixture
from .forward import forward_pass, rows_on_tape
from .machine import read_chain
from .states import predicted_at_observations


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
    to, p, J = call.results, call.plan[PLAN.p], call.record[RECORD.n_rows]
    data = single_record(call, 0, 0, J)
    laws = Laws(
        np.zeros(1, np.int64), reals_at(to[RESULTS.predicted], (J, p)),
        reals_at(to[RESULTS.predicted_cov], (J, p, p)), reals_at(to[RESULTS.log_below], (J, p)),
        reals_at(to[RESULTS.log_above], (J, p)),
    )  # fmt: skip
    forget(laws, 0)
    system = read_system(call.plan, data.theta, data.inputs)
    chain = read_chain(call.plan, data.theta, data.inputs)
    tape = np.empty((rows_on_tape(data.steps), chain.n_states))
    code, end = forward_pass(chain, data, np.empty(J), tape)
    known = J if code == NONE else int(end)
    weights = predicted_at_observations(chain, data, tape, known)
    for j in range(known):
        _write_law(system, chain, data, j, weights[j], laws)
    return status


PREDICTIONS_OF_CHAIN = plan_entry(_predictions, "markov_chain_predictions")
