"""A PyMC model's log-density as one call of machine code.

The value variables that a sampler moves are joined into one vector; the variables that it does not
move and the noise of estimated likelihoods are arguments beside it. The health of the filters
comes out of the same call, so that a failure has a reason and costs no second evaluation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike
from pymc.model import Model
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.native.pytensor_function import NativeFunction
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.pymc_model.graph_rewrites import (
    autoregressive_noise,
    with_filter,
    with_likelihood_callback,
)
from pymc_statespace_filters.pymc_model.inspection import (
    health_outputs,
    log_density_terms,
    state_space_names,
)
from pymc_statespace_filters.sampling.kernel.state import RAISED, Density, Evaluation
from pymc_statespace_filters.sampling.kernel.transition import evaluate
from pymc_statespace_filters.sampling.target.leader_follower import Leader, own_errors


class LogDensity:
    """Log-density of a model on its unconstrained space, noise explicit.

    Parameters
    ----------
    model : pymc.Model
    held : sequence of TensorVariable
        Continuous value variables that become one vector, in this order.
    point : mapping of str to ndarray
        Any point of the model; of the variables in the vector only shapes are read.
    seeds : mapping of str to shared variable
        The noise seeds, by the name of their StateSpace variable.
    compile_kwargs : dict, optional
        Passed to PyMC's compiler.
    holds_noise : bool
        Whether every evaluation is on the noise of the model's own seeds. Their normals are then
        made once, in `prepare`, and the seeds of a call are not read.
    correlation : float, optional
        If given, the noise of an evaluation is that of the one before, moved: its normals are
        ``correlation`` times theirs plus fresh ones, of the same variance.
    graph : TensorVariable, optional
        The log-density if it is not the model's own, see `screening_density`.
    group : Ranks, optional
        Ranks that evaluate the noisy likelihoods together. This one, their first, has the
        log-density; the others `lockstep.follow`.

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
        correlation: float | None = None,
        graph: TensorVariable | None = None,
        group: Communicator | None = None,
    ):
        not_held = [v for v in model.value_vars if v not in held]
        self.others = tuple(v.name for v in not_held)
        self.correlation = correlation
        density = model.logp() if graph is None else graph
        outputs = [density, *health_outputs([density])]
        self._n_healths = len(outputs) - 1
        seed_inputs = {seed: seed.type(f"{name}_seed_input") for name, seed in seeds.items()}
        noise_inputs: list[Variable] = []
        noise: list[Variable] = []
        self._leader: Leader | None = None
        self._is_delegable = False
        self._moves_noise = correlation is not None and bool(seeds) and not holds_noise
        if self._moves_noise:
            graphs, moved = autoregressive_noise(outputs, seeds)
            outputs = [*graphs, *moved.moved]
            noise_inputs, noise = [moved.correlation, *moved.normals], list(moved.sizes)
        else:
            # Where there is one rank too: the same machine code gives the same bits.
            outputs, delegable = with_likelihood_callback(outputs, seeds if holds_noise else {})
            noise_inputs, noise = list(delegable.normals), list(delegable.normals.values())
            if delegable.kinds:
                self._is_delegable = True
                noise_inputs = [delegable.address, *noise_inputs]
            if group is not None:
                self._leader = Leader(group, delegable.kinds)
        # Belongs to the data: the stored normals, or how many there are.
        self._make_noise: Any = compile_pymc([], noise) if noise else list
        self._n_noises = len(noise)
        outputs, joined = join_nonshared_inputs(point, outputs, held, shared_inputs=seed_inputs)
        inputs = [joined, *not_held, *noise_inputs, *seed_inputs.values()]
        self._function = compile_pymc(inputs, outputs, **(compile_kwargs or {}))
        self._function.trust_input = True
        self._n_seeds = len(seeds)
        self._start = np.concatenate([np.ravel(point[v.name]) for v in held], dtype=np.float64)
        self._others = [np.array(point[name]) for name in self.others]
        self._native: NativeFunction | None = None
        self._normals: list[np.ndarray] = []

    def __getstate__(self) -> dict:
        """Leave the machine code behind: another process takes its own."""
        return self.__dict__ | {"_native": None, "_normals": []}

    @property
    def n_carried(self) -> int:
        """How many normals a chain carries along; known once prepared."""
        return sum(normals.size for normals in self._normals) if self._moves_noise else 0

    def prepare(self) -> NativeFunction:
        """Take hold of the machine code and of the data as they are now."""
        self._normals = self._first_normals()
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        inputs = self._inputs(self._start, self._others, np.zeros(()), self._normals, seeds)
        with own_errors(self._leader):
            self._native = NativeFunction(self._function, inputs)
        return self._native

    def bind(self) -> "BoundDensity":
        """Make the log-density callable for one thread, with arrays of its own."""
        native = self._native or self.prepare()
        position, others = self._start.copy(), [value.copy() for value in self._others]
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        correlation, carried = np.zeros(()), np.zeros(self.n_carried)
        normals = self._normals
        if self._moves_noise:
            ends = np.cumsum([values.size for values in normals])
            normals = np.split(carried, ends[:-1])
        inputs = self._inputs(position, others, correlation, normals, seeds)
        call, kept = native.bind(inputs)
        density = Density(call, position, seeds, self._n_healths)
        leader = self._leader
        return BoundDensity(density, others, correlation, carried, native, inputs, kept, leader)

    def _inputs(
        self,
        position: np.ndarray,
        others: Sequence[np.ndarray],
        correlation: np.ndarray,
        normals: Sequence[np.ndarray],
        seeds: np.ndarray,
    ) -> list[np.ndarray]:
        """Arguments of the compiled function, views where it reads a part."""
        first = [correlation] if self._moves_noise else []
        if self._is_delegable:
            first = [np.zeros((), np.int64) if self._leader is None else self._leader.address]
        each_seed = [seeds[i : i + 1].reshape(()) for i in range(seeds.size)]
        return [position, *others, *first, *normals, *each_seed]

    def _first_normals(self) -> list[np.ndarray]:
        """The stored normals; none where several ranks share the members and make their own."""
        if self._leader is not None:
            return [np.empty(0) for _ in range(self._n_noises)]
        noise = self._make_noise()
        return [np.zeros(int(size)) for size in noise] if self._moves_noise else noise


@dataclass(frozen=True)
class BoundDensity:
    """A log-density with the arrays that its machine code reads and writes.

    Attributes
    ----------
    density : Density
        For machine code.
    others : list of ndarray
        Values of the variables that are not in the vector.
    correlation : ndarray, shape ()
        Of the noise of an evaluation with the noise in ``carried``; 0 draws it afresh.
    carried : ndarray, shape (n_carried,)
        The normals that are moved.
    native : NativeFunction
    inputs : list of ndarray
        What it is called with.
    kept : object
        What must live as long as the call.
    leader : Leader or None
        If the likelihoods are evaluated by several ranks.
    """

    density: Density
    others: list[np.ndarray]
    correlation: np.ndarray
    carried: np.ndarray
    native: NativeFunction
    inputs: list[np.ndarray]
    kept: Any
    leader: Leader | None

    def __call__(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: ArrayLike
    ) -> Evaluation:
        """Evaluate once, from Python.

        Parameters
        ----------
        position : ndarray, shape (d,)
            The joined vector.
        others : sequence of ndarray
            Values of the variables that are not in it.
        seeds : array_like of int64, shape (noisy,)
            One for each noise seed; not read where the noise is held.

        Returns
        -------
        Evaluation

        Raises
        ------
        Exception
            What the model raises.
        """
        self.density.position[:] = position
        self.density.seeds[:] = seeds
        for mine, value in zip(self.others, others, strict=True):
            mine[...] = value
        result = evaluate(self.density)
        if result.failure == RAISED:
            self.raise_error()
        return result

    def raise_error(self) -> None:
        """Evaluate again in Python, to raise what the machine code met."""
        with own_errors(self.leader):
            self.native(*self.inputs)


def screening_density(model: Model, screen: Any, power: float) -> TensorVariable:
    """Graph of a cheap log-density: another filter's likelihood, tempered.

    Parameters
    ----------
    model : pymc.Model
    screen : filter
        Takes the place of the filter of every StateSpace variable.
    power : float
        By which the likelihoods of these variables enter. Priors and other terms enter whole.

    Returns
    -------
    TensorVariable

    Raises
    ------
    ModelError
        If the filter cannot treat a system.
    """
    names = state_space_names(model)
    total = sum(
        pt.sum(term) * (power if name in names else 1.0) for name, term in log_density_terms(model)
    )
    try:
        return with_filter([total], model, dict.fromkeys(names, screen))[0]
    except ModelError as error:
        raise ModelError(f"screen={screen!r}: {error}") from error
