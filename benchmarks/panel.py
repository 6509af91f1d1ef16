"""Many records of one system: a panel, and the single likelihood record by record.

100 records of 50 observations, 20 steps apart, each with parameters of its own. The panel is the
operation that a PyMC model has; the single kernels are called in a compiled loop. Times are for
each record.
"""

import numba
import numpy as np
import pytensor
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from benchmarks.measure import Peers, Row, compare
from benchmarks.ours import machine_code
from benchmarks.systems import SYSTEMS, theta_of
from benchmarks.timing import Timed
from pymc_statespace_filters.ops import signatures
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood, TapedLogLikelihood, TapePullback

N_RECORDS = 100
STEPS = np.arange(0, 1000, 20)
PANEL, ALONE = "ours, a panel", "ours, one record after the other"

CASES = {
    "EKF, double well": ("double_well", psf.EKF(), False),
    "UKF, double well": ("double_well", psf.UKF(), False),
    "EKF, mass-spring-damper, shared inputs": ("mass_spring_damper", psf.EKF(), False),
    "EKF, mass-spring-damper, own inputs": ("mass_spring_damper", psf.EKF(), True),
}


class Panel:
    """The log-likelihood of a panel, as tasks to time."""

    def __init__(self, name: str, filter, own_inputs: bool) -> None:
        self.system, truth = SYSTEMS[name]
        self.filter = filter
        rng, n_steps, G = np.random.default_rng(1), STEPS[-1] + 1, N_RECORDS
        at = theta_of(self.system, truth)
        self.theta = at * rng.uniform(0.95, 1.05, size=(G, at.size))
        record = np.repeat(np.arange(G), STEPS.size)
        first_input = n_steps * record * own_inputs
        self.rows = np.stack([record, np.tile(STEPS, G), first_input], axis=1)
        self.observed = rng.normal(scale=0.5, size=(record.size, self.system.p))
        n_rows = n_steps * (G if own_inputs else 1)
        self.inputs = rng.normal(size=(n_rows, self.system.n_input_columns))

    def together(self, *, gradient: bool) -> Timed:
        """The compiled function of a PyMC model."""
        theta = pt.dmatrix("theta")
        table = [pytensor.shared(a) for a in (self.rows, self.observed, self.inputs)]
        terms, _ = LogLikelihood(self.system, self.filter, signatures.PANEL)(theta, *table, 0.0, 0)
        total = terms.sum()
        outputs = [total, pytensor.grad(total, theta)] if gradient else [total]
        run = machine_code([theta], outputs)
        return Timed(lambda s: run(self.theta)[0].item(), per=N_RECORDS)

    def alone(self, *, gradient: bool) -> Timed:
        """The functions of a single record, one record after the other."""
        forward, reverse = (
            kernel(kind(self.system, self.filter)).function
            for kind in (TapedLogLikelihood if gradient else LogLikelihood, TapePullback)
        )

        @numba.njit
        def run(theta, rows, observed, inputs):
            total, bars, J = 0.0, np.ones(STEPS.size), STEPS.size
            for i in range(theta.shape[0]):
                d, u = observed[i * J : (i + 1) * J], inputs[rows[i * J, 2] :]
                found = forward(theta[i], STEPS, d, u, 0.0, 0)
                total += found[0].sum()
                if gradient:
                    reverse(theta[i], STEPS, d, u, 0.0, 0, found[2], bars)
            return total

        table = self.rows, self.observed, self.inputs
        return Timed(lambda s: run(self.theta, *table), per=N_RECORDS)


def panel(peers: Peers) -> list[Row]:
    """Value, and value with gradient."""
    rows = []
    for title, case in CASES.items():
        task = Panel(*case)
        for what, gradient in (("value", False), ("value and gradient", True)):
            makers = {
                PANEL: lambda task=task, g=gradient: task.together(gradient=g),
                ALONE: lambda task=task, g=gradient: task.alone(gradient=g),
            }
            work = f"{title}, {N_RECORDS} records: {what} of a record"
            rows += compare(work, makers)
    return rows
