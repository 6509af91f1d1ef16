"""A PyMC model's log-density as one call of machine code.

The value variables that a sampler moves are joined into one vector; the variables that it does not
move and the noise seeds of estimated likelihoods are arguments beside it. The health of the filters
comes out of the same call, so that a failure has a reason and costs no second evaluation.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.inspection import health_outputs, hold_noise, with_filter

# Reason of a failure that no filter reports.
NOT_A_NUMBER = -1


class Evaluation(NamedTuple):
    """What one call gives.

    Attributes
    ----------
    log_density : float
        Never NaN nor plus infinity; a failed evaluation is minus infinity.
    failure : int
        0, or the code of the reason: a key of ``inspection.FAILURES``, or ``NOT_A_NUMBER``.
    n_effective : float
        Smallest effective number of particles in any filter, infinity without noisy filters.
    """

    log_density: float
    failure: int
    n_effective: float


class LogDensity:
    """Log-density of a model on its unconstrained space, seeds explicit.

    Parameters
    ----------
    model : pymc.Model
    held : sequence of TensorVariable
        Continuous value variables that become one vector, in this order.
    point : mapping of str to ndarray
        Any point of the model; only shapes are read.
    seeds : mapping of str to shared variable
        The noise seeds, by the name of their StateSpace variable.
    holds_noise : bool
        Whether every evaluation is on the noise of the model's own seeds. Their normals are then
        made once, in `prepare`, and the seeds of a call are not read.
    filters : mapping of str to filter, optional
        Filters that stand in for those of the named StateSpace variables.
    compile_kwargs : dict, optional
        Passed to PyMC's compiler.

    Attributes
    ----------
    others : tuple of str
        Names of the value variables that are not in the vector, in the order of the arguments.
    """

    def __init__(
        self,
        model: Model,
        held: Sequence[TensorVariable],
        point: Mapping[str, np.ndarray],
        seeds: Mapping[str, TensorVariable],
        compile_kwargs: dict | None = None,
        *,
        holds_noise: bool = False,
        filters: Mapping[str, Any] | None = None,
    ):
        not_held = [v for v in model.value_vars if v not in held]
        self.others = tuple(v.name for v in not_held)
        seed_inputs = {seed: seed.type(f"{name}_seed_input") for name, seed in seeds.items()}
        logp = model.logp()
        if filters:
            (logp,) = with_filter([logp], model, filters)
        outputs = [logp, *health_outputs([logp])]
        noise_inputs = list(seed_inputs.values())
        self._make_normals = None
        if holds_noise and seeds:
            outputs, normals = hold_noise(outputs, seeds)
            noise_inputs, seed_inputs = list(normals), {}
            self._make_normals = compile_pymc([], list(normals.values()))
        outputs, joined = join_nonshared_inputs(point, outputs, held, shared_inputs=seed_inputs)
        inputs = [joined, *not_held, *noise_inputs]
        self._n_inputs = len(inputs)
        self._function = compile_pymc(inputs, outputs, **(compile_kwargs or {}))
        self._function.trust_input = True
        self._call: Callable[..., Sequence[np.ndarray]] | None = None
        self._normals: Sequence[np.ndarray] | None = None

    def __getstate__(self) -> dict:
        """Leave the machine code behind: another process takes its own."""
        return self.__dict__ | {"_call": None, "_normals": None}

    def prepare(self) -> Callable[..., Sequence[np.ndarray]]:
        """Take hold of the machine code and of the data as they are now."""
        function = self._function
        call = function
        if hasattr(function.vm, "jit_fn"):  # else it is a mode without numba
            machine_code = function.vm.jit_fn
            data = [cell.storage[0] for cell in function.input_storage[self._n_inputs :]]

            def call(*args: np.ndarray) -> Sequence[np.ndarray]:
                return machine_code(*args, *data)

        self._call = call
        if self._make_normals is not None:
            self._normals = self._make_normals()
        return call

    def __call__(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: Sequence[np.ndarray]
    ) -> Evaluation:
        """Evaluate once.

        Parameters
        ----------
        position : ndarray, shape (d,)
            The joined vector.
        others : sequence of ndarray
            Values of the variables named in ``others``.
        seeds : sequence of ndarray of int64, shape ()
            One for each noise seed; not read where the noise is held.

        Returns
        -------
        Evaluation
        """
        call = self._call or self.prepare()
        noise = seeds if self._normals is None else self._normals
        value, *healths = call(position, *others, *noise)
        log_density = float(value)
        n_effective = np.inf
        for health in healths:
            n_effective = min(n_effective, float(health[0]))
            if health[1] != 0.0:
                return Evaluation(-np.inf, int(health[1]), n_effective)
        if not log_density < np.inf:
            return Evaluation(-np.inf, NOT_A_NUMBER, n_effective)
        return Evaluation(log_density, 0, n_effective)
