"""Libraries of candidate terms for an equation: monomials of states, and a user's functions."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations_with_replacement
from typing import Any

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_count
from .equations import Equation, as_symbol, read_equation, static_shape
from .signature import checked_names, parameter_names

__all__ = ["TermLibrary", "polynomial_terms"]

type Monomial = tuple[int, ...]  # the exponent of each state


@dataclass(frozen=True)
class TermLibrary:
    """Candidate terms of an equation, without their coefficients; see `polynomial_terms`.

    ``len`` is the number of terms.

    Attributes
    ----------
    states : tuple of str
        The states that the terms depend on.
    monomials : tuple of tuple of int
        Exponents of the states in each product of powers.
    functions : tuple of Equation
        The further terms.
    """

    states: tuple[str, ...]
    monomials: tuple[Monomial, ...]
    functions: tuple[Equation, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms in their order, such as ``("1", "v", "w", "v^2", "v w", "w^2")``."""
        named = (_name(one, self.states) for one in self.monomials)
        return (*named, *(function.role for function in self.functions))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Arguments of the further terms that are not states."""
        return parameter_names(self.functions)[0]

    def __len__(self) -> int:
        return len(self.monomials) + len(self.functions)

    def __call__(self, x: Any, **parameters: Any) -> TensorVariable:
        """Evaluate all terms.

        Parameters
        ----------
        x : tensor_like, shape (n_states, ...), or list
            The states of the library, in their order; a single state may be a scalar.
        **parameters : tensor_like
            The `parameters` of the library; one with a default may be left out.

        Returns
        -------
        TensorVariable, shape (n_terms, ...)

        Raises
        ------
        ModelError
            If the number of states is another one, or `parameters` are not those of the library.
        """
        states = split_states(self.states, x)
        values = dict(zip(self.states, states, strict=True)) | self._complete(parameters)
        terms = [_product(one, states) for one in self.monomials]
        terms += [as_symbol(function.role, function(values)) for function in self.functions]
        # A constant has the shape of the others.
        return pt.stack(pt.broadcast_arrays(*terms) if states[0].type.ndim else terms)

    def _complete(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """All parameters, given and default ones."""
        names, defaults = parameter_names(self.functions)
        values = dict(defaults) | dict(given)
        if set(values) != set(names):
            raise ModelError(
                f"the library must get its parameters by name, {list(names)}, got {list(given)}"
            )
        return values


def polynomial_terms(
    states: str | Sequence[str],
    degree: int,
    *,
    lowest: int = 0,
    also: Mapping[str, Callable[..., Any]] | None = None,
) -> TermLibrary:
    """Make a library of candidate terms: all monomials of some states, and further functions.

    The result has a name for each term and gives their values at states, to be multiplied by a
    vector of coefficients, which is a parameter of the equation:

    >>> import pymc_statespace_filters as psf
    >>> terms = psf.mechanics.polynomial_terms(["v", "w"], 2)
    >>> terms.names
    ('1', 'v', 'w', 'v^2', 'v w', 'w^2')
    >>> def drift(x, a, b):
    ...     return [a @ terms(x), b @ terms(x)]

    A parameter that is a vector has its length in ``shapes`` of the `StateSpaceModel`. In PyMC,
    ``dims`` name its elements:

    ``StateSpaceModel(..., shapes={"a": (len(terms),), "b": (len(terms),)})``

    ``pm.Model(coords={"term": terms.names})`` with ``pm.Normal("a", 0, 1, dims="term")``

    Parameters
    ----------
    states : str or sequence of str
        Names of the states that the terms depend on, not necessarily all states of the system.
    degree : int
        The highest degree of a monomial, the sum of its exponents.
    lowest : int
        The lowest degree. 1 leaves out the constant.
    also : mapping of str to callable, optional
        Further terms by name: functions of states, which they have as arguments by name. Every
        other argument is a parameter of the library.

    Returns
    -------
    TermLibrary
        Monomials by degree, then the further terms in their order. ``terms(x)`` takes the states as
        a vector or a list, ``terms(x, gap=gap)`` also parameters; ``terms.names`` and
        ``len(terms)`` are the names and the number of terms.

    Raises
    ------
    ModelError
        If the degrees are no integers with ``0 <= lowest <= degree``, if names of states or terms
        are not distinct, or if a function has no readable arguments.

    Examples
    --------
    An oscillator whose spring and damper are unknown. One of the candidates for the spring has a
    gap, which is a parameter, too:

    >>> springs = psf.mechanics.polynomial_terms(
    ...     "z", 3, lowest=1, also={"gap": lambda z, gap: psf.mechanics.freeplay(z, 1.0, gap)}
    ... )
    >>> dampers = psf.mechanics.polynomial_terms(
    ...     "v", 3, lowest=1, also={"|v| v": lambda v: abs(v) * v}
    ... )
    >>> springs.names, dampers.names
    (('z', 'z^2', 'z^3', 'gap'), ('v', 'v^2', 'v^3', '|v| v'))
    >>> def drift(x, k, c, gap):
    ...     z, v = x
    ...     return [v, -k @ springs(z, gap=gap) - c @ dampers(v)]
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(drift, [[0.0], [0.1]], dt=0.01),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.01]],
    ...     initial_mean=[0.0, 0.0],
    ...     initial_cov=[[1.0, 0.0], [0.0, 1.0]],
    ...     shapes={"k": (len(springs),), "c": (len(dampers),)},
    ... )
    >>> system.parameters
    ('k', 'c', 'gap')

    The values of the terms, here at z = 0.5, and a force at many displacements:

    >>> springs(0.5, gap=0.2).eval()
    array([0.5  , 0.25 , 0.125, 0.3  ])
    >>> ([1.0, 0.0, 2.0, 0.0] @ springs([[0.0, 0.5, 1.0]], gap=0.2)).eval()
    array([0.  , 0.75, 3.  ])
    """
    names = state_names(states)
    lowest = check_count("lowest", lowest, 0)
    degrees = range(lowest, check_count("degree", degree, lowest) + 1)
    functions = [read_equation(name, function, names) for name, function in (also or {}).items()]
    library = TermLibrary(names, tuple(_monomials(len(names), degrees)), tuple(functions))
    if twice := [name for name, count in Counter(library.names).items() if count > 1]:
        raise ModelError(f"also must not name monomials of the library, got {twice}")
    return library


def state_names(states: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of the states that terms depend on, at least one."""
    names = checked_names("states", (states,) if isinstance(states, str) else states, None)
    if not names:
        raise ModelError(f"states must name at least one state, got {states!r}")
    return names


def split_states(names: Sequence[str], x: Any) -> list[TensorVariable]:
    """Return the states with these names one by one, of a vector or a list of them."""
    symbol = as_symbol("x", x)
    if symbol.type.ndim == 0 and len(names) == 1:
        return [symbol]
    n = static_shape(symbol)[0] if symbol.type.ndim else 1
    if n != len(names):
        raise ModelError(
            f"x must hold the states of the library, {list(names)}, got {n}: choose them, as in "
            "terms([x[0], x[2]])"
        )
    return [symbol[i] for i in range(len(names))]


def _monomials(n: int, degrees: Sequence[int]) -> list[Monomial]:
    """Exponents of all products of n states, by degree, those of the first states first."""
    factors = chain.from_iterable(
        combinations_with_replacement(range(n), degree) for degree in degrees
    )
    return [tuple(one.count(i) for i in range(n)) for one in factors]


def _name(monomial: Monomial, states: Sequence[str]) -> str:
    powers = [
        state if exponent == 1 else f"{state}^{exponent}"
        for state, exponent in zip(states, monomial, strict=True)
        if exponent
    ]
    return " ".join(powers) or "1"


def _product(monomial: Monomial, states: Sequence[TensorVariable]) -> TensorVariable:
    value = as_symbol("terms", 1.0)
    for state, exponent in zip(states, monomial, strict=True):
        for _ in range(exponent):
            value = value * state
    return value
