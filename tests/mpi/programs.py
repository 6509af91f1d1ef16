"""What users' scripts do, and what may befall them: each function is one, by its name."""

import pickle
import sys
import time
import warnings
from pathlib import Path
from typing import ClassVar

import numpy as np
import pymc as pm
from mpi4py import MPI
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.run import chain_task
from tests.kernels import with_kernel
from tests.sampling.test_sample_dram import state_space_model
from tests.waiting import LIMIT

CHAINS = 3


class Fragile(Op):
    """Zero, in Python; an error at the hundredth value above four."""

    __props__ = ()
    evaluations: ClassVar[list[float]] = []

    def make_node(self, mu):
        return Apply(self, [mu], [mu.type()])

    def perform(self, node, inputs, output_storage):
        (mu,) = inputs
        time.sleep(0.001)
        if mu > 4:
            self.evaluations.append(mu)
        if mu > 4 and len(self.evaluations) >= 100:
            raise ArithmeticError("no more")
        output_storage[0][0] = np.zeros_like(inputs[0])


def failing(chain: str) -> None:
    """A model that raises in one chain, in the midst of it."""
    with pm.Model() as model:
        pm.Potential("fragile", Fragile()(pm.Normal("mu", sigma=100)))
    psf.sample_dram(
        10**6,
        tune=0,
        chains=CHAINS,
        cores=2,
        model=model,
        initvals=[{"mu": 7.0 if i == int(chain) else 0.0} for i in range(CHAINS)],
        kernel={"proposal_cov": [[1e-9]]},
        progressbar=False,
        comm="world",
    )


def resumed(**settings):
    """A run that is long enough to be ended in its midst."""
    return psf.sample_dram(
        6000,
        tune=3000,
        chains=CHAINS,
        cores=1,
        model=state_space_model(psf.BootstrapPF(20)),
        random_seed=1,
        progressbar=False,
        **with_kernel(settings),
    )


def long_run(folder: str, iterations: str = "inf") -> None:
    """Store every block of iterations; a chain that has made so many waits to be killed."""
    made = chain_task.ChainTask._advance

    def advance(self):
        if self.n_done >= float(iterations):
            time.sleep(LIMIT)
        made(self)

    chain_task.ChainTask._advance = advance
    chain_task.CHECKPOINT_SECONDS = 0.0
    # Only the first rank sees the folder.
    name = "not-seen" if MPI.COMM_WORLD.rank else "run"
    tree = resumed(checkpoint=Path(folder, name), comm="world")
    if tree is not None:
        draws = {name: tree["posterior"][name].values for name in tree["posterior"].data_vars}
        Path(folder, "draws").write_bytes(pickle.dumps(draws))


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of object mode
    globals()[sys.argv[1]](*sys.argv[2:])
