"""Our likelihoods through the public operation, compiled as PyTensor compiles them for a model.

The timing is of the machine code that PyTensor compiled from the graph. Its call from Python is the
same for any function and has its own row.
"""

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.replace import vectorize_graph

from benchmarks.systems import STEPS, SYSTEMS, simulated, theta_of
from benchmarks.timing import Timed
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.system.input_columns import check_inputs
from pymc_statespace_filters.system.time_axis import TimeAxis


class Likelihood:
    """The log-likelihood of one record by one filter, as a task to time."""

    def __init__(self, system, filter, truth, *, steps=STEPS, observed=None) -> None:
        self.system, self.filter, self.steps = system, filter, np.asarray(steps)
        self.at = theta_of(system, truth)
        if observed is None:
            self.inputs, self.observed = simulated(system, truth, self.steps)
        else:
            axis = TimeAxis(self.steps, 0.0, system.dt)
            self.inputs, self.observed = check_inputs(None, system, axis), observed

    def total(self, theta, noise=0, operation=LogLikelihood):
        record = [pytensor.shared(a) for a in (self.steps, self.observed, self.inputs)]
        if isinstance(noise, int):
            noise = pt.constant(noise, dtype="int64")
        terms, _ = operation(self.system, self.filter)(theta, *record, np.float64(0.0), noise)
        return terms.sum()

    def value(self) -> Timed:
        """With new noise at every call, where the filter has noise."""
        theta, seed = pt.dvector("theta"), pt.lscalar("seed")
        run = machine_code([theta, seed], [self.total(theta, seed)])
        return Timed(lambda s: run(self.at, np.asarray(s))[0].item())

    def on_held_noise(self) -> Timed:
        """With normals that are drawn and stored once: common random numbers."""
        theta, stored, seed = pt.dvector("theta"), pt.dvector("stored"), pt.lscalar("seed")
        normals = StoredNoise(self.system, self.filter)(pt.constant(self.steps), seed)
        draw = pytensor.function([seed], normals, mode="NUMBA")
        total = self.total(theta, stored, LogLikelihoodOfNoise)
        run = machine_code([theta, stored], [total])
        return Timed(lambda noise: run(self.at, noise)[0].item(), draw)

    def value_and_gradient(self) -> Timed:
        theta = pt.dvector("theta")
        total = self.total(theta)
        run = machine_code([theta], [total, pytensor.grad(total, theta)])
        return Timed(lambda s: run(self.at)[0].item())

    def called_from_python(self) -> Timed:
        """The value by PyTensor's own function, as a sampler in Python calls it."""
        theta = pt.dvector("theta")
        function = pytensor.function([theta], self.total(theta), mode="NUMBA", trust_input=True)
        return Timed(lambda s: function(self.at).item())

    def batch(self, n_points: int) -> Timed:
        """Several nearby parameter points in one call, as for several chains."""
        theta, points = pt.dvector("theta"), pt.dmatrix("points")
        run = machine_code([points], [vectorize_graph(self.total(theta), {theta: points})])
        spread = 0.01 * np.random.default_rng(0).normal(size=(n_points, self.at.size))
        at = self.at * (1.0 + spread)
        at[0] = self.at
        return Timed(lambda s: run(at)[0][0], per=n_points)


def machine_code(inputs, outputs):
    """Return PyTensor's compiled function without the checks of its call from Python."""
    function = pytensor.function(inputs, outputs, mode="NUMBA")
    cells = [cell.storage[0] for cell in function.input_storage[len(inputs) :]]
    return lambda *arguments: function.vm.jit_fn(*arguments, *cells)


def of(name: str, filter) -> Likelihood:
    """Return the likelihood of the record of one of the systems."""
    system, truth = SYSTEMS[name]
    return Likelihood(system, filter, truth)
