"""A conjugate model whose likelihood is known only up to seeded noise, as of a particle filter."""

from typing import ClassVar

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

DATA = np.array([0.9, 2.1, 1.4, 0.2, 1.7])
PRIOR_SD = 2.0


def exact_posterior():
    """Mean and standard deviation of mu given the data."""
    precision = PRIOR_SD**-2 + len(DATA)
    return DATA.sum() / precision, precision**-0.5


def standard_normal(seed):
    """A standard normal variate: seeds are uniform already, so this only transforms them."""
    uniform = (pt.mod(seed, 2**31).astype("float64") + 0.5) / 2**31
    return np.sqrt(2.0) * pt.erfinv(2.0 * uniform - 1.0)


class Recorder(Op):
    """Hands a seed on and notes it down; in PyTensor's modes without machine code."""

    __props__ = ()
    seen: ClassVar[list[int]] = []

    def make_node(self, seed):
        return Apply(self, [seed], [seed.type()])

    def perform(self, node, inputs, output_storage):
        self.seen.append(int(inputs[0]))
        output_storage[0][0] = np.asarray(inputs[0])


def noisy_model(noise_sd, *, records=False):
    """Give the model and its noise seed; the expected likelihood is the exact one."""
    seed = pytensor.shared(np.array(20, dtype=np.int64), name="d_seed")
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, PRIOR_SD)
        exact = pt.sum(pm.logp(pm.Normal.dist(mu, 1.0), DATA))
        used = Recorder()(seed) if records else seed
        noise = noise_sd * standard_normal(used) - 0.5 * noise_sd**2
        pm.Potential("d", exact + noise)
    return model, seed
