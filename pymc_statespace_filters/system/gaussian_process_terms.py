r"""A Gaussian process of states as a sum of sines, whose coefficients are independent.

On the domain [-L, L] of one state the functions

.. math:: \phi_j(x) = L^{-1/2} \sin(\omega_j (x + L)), \quad \omega_j = \pi j / 2L, j = 1, 2, ...

are the eigenfunctions of the Laplacian that vanish at its ends, and a stationary kernel with the
spectral density S is about :math:`\sum_j S(\omega_j) \phi_j(x) \phi_j(y)` (Solin and Särkkä 2020,
equation 20). Of several states they are products, one factor for each state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Constant
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_count, check_floats
from .equations import as_symbol, static_shape
from .term_library import split_states, state_names

__all__ = ["KERNEL_LENGTHS", "GaussianProcessTerms", "gaussian_process_terms"]

KERNEL_LENGTHS = "lengths of the kernel"  # the name by which `field` finds them in a model

# Half the domain, in halves of the box: for the kernels of Matern what Riutort-Mayol et al. (2023)
# recommend at a length of a third of half the box.
_WIDER = 1.5
_MOST_STATES = 3

# By kernel: the smoothness nu, infinite for the squared exponential, and the product of frequency
# and length below which lie nine tenths of the variance along a state. The density of frequencies
# is that of Student's t with 2 nu degrees of freedom.
_KERNELS = {
    "matern32": (1.5, 2.3533634),
    "matern52": (2.5, 2.0150484),
    "squared_exponential": (math.inf, 1.6448536),
}


@dataclass(frozen=True)
class GaussianProcessTerms:
    """Basis functions of a Gaussian process of some states; see `gaussian_process_terms`.

    ``len`` is the number of functions. The attributes are the arguments, one entry per state.
    """

    states: tuple[str, ...]
    box: tuple[tuple[float, float], ...]
    n: tuple[int, ...]
    kernel: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the functions in their order: the half waves along each state, ``"v2 w1"``."""
        return tuple(
            " ".join(f"{state}{j}" for state, j in zip(self.states, numbers, strict=True))
            for numbers in self._half_waves()
        )

    @property
    def boundary(self) -> NDArray[np.float64]:
        """Where the functions vanish, beyond the box: an array (n_states, 2) of lowest, highest."""
        low, high = np.transpose(self.box)
        return np.outer(low + high, [0.5, 0.5]) + np.outer(high - low, [-0.5, 0.5]) * _WIDER

    @property
    def shortest_length(self) -> NDArray[np.float64]:
        """The smallest length (n_states,) of which the sines hold 90 % of the variance."""
        return _KERNELS[self.kernel][1] / (self._slowest() * self.n)

    def __len__(self) -> int:
        return math.prod(self.n)

    def __call__(self, x: Any) -> TensorVariable:
        """Evaluate all functions (n_terms, ...) at states (n_states, ...), as a `TermLibrary`."""
        states = split_states(self.states, x)
        factors = [
            _sines(frequency * (state - low), n, math.sqrt(2 / (high - low)))
            for state, n, frequency, (low, high) in zip(
                states, self.n, self._slowest(), self.boundary, strict=True
            )
        ]
        shape = states[0].shape
        return reduce(
            lambda a, b: (a[:, None] * b[None]).reshape((-1, *shape), ndim=shape.type.shape[0] + 1),
            factors,
        )

    def prior_sd(self, lengthscale: Any, amplitude: Any) -> TensorVariable:
        """Prior standard deviations of the coefficients under the kernel.

        Parameters
        ----------
        lengthscale : tensor_like, scalar or shape (n_states,)
            The length of the kernel along each state, in its unit, or one for all. Numbers must be
            at least `shortest_length`; for a variable, let its prior begin there.
        amplitude : tensor_like, scalar
            The standard deviation of the process, in the unit of the equation.

        Returns
        -------
        TensorVariable, shape (n_terms,)
            The square root of the spectral density at the frequencies of the functions.

        Raises
        ------
        ModelError
            If a number is not positive, a length is below the shortest, or the shape is another.
        """
        d, nu = len(self.states), _KERNELS[self.kernel][0]
        lengths = as_symbol("lengthscale", lengthscale)
        amplitude = as_symbol("amplitude", amplitude)
        self._check_prior(lengths, amplitude)
        lengths = pt.broadcast_to(lengths, (d,)).copy(name=KERNEL_LENGTHS)
        frequencies = np.array(list(self._half_waves())) * self._slowest()
        squares = pt.sum((frequencies * lengths) ** 2, axis=1)
        if math.isinf(nu):
            density = (2 * math.pi) ** (d / 2) * pt.exp(-squares / 2)
        else:
            log_scale = d / 2 * math.log(4 * math.pi) + nu * math.log(2 * nu)
            log_scale += math.lgamma(nu + d / 2) - math.lgamma(nu)
            density = pt.exp(log_scale - (nu + d / 2) * pt.log(2 * nu + squares))
        return amplitude * pt.sqrt(pt.prod(lengths) * density)

    def _half_waves(self) -> product:
        """Of each function the numbers of half waves; those along the last state change fastest."""
        return product(*(range(1, n + 1) for n in self.n))

    def _slowest(self) -> NDArray[np.float64]:
        """The frequency (n_states,) of half a wave within the boundary, in radians per unit."""
        return np.pi / np.diff(self.boundary)[:, 0]

    def _check_prior(self, lengths: TensorVariable, amplitude: TensorVariable) -> None:
        shapes = (), (len(self.states),), (None,)  # the last of a variable with dims
        if static_shape(lengths) not in shapes:
            raise ModelError(
                f"lengthscale must be a number or one for each of {list(self.states)}, got shape "
                f"{static_shape(lengths)}"
            )
        if amplitude.type.ndim:
            raise ModelError(f"amplitude must be a number, got {amplitude.type.ndim} dimension(s)")
        for name, symbol in {"lengthscale": lengths, "amplitude": amplitude}.items():
            if isinstance(symbol, Constant) and not (symbol.data > 0).all():
                raise ModelError(f"{name} must be positive, got {symbol.data.tolist()}")
        if isinstance(lengths, Constant) and (lengths.data < self.shortest_length).any():
            needed = np.ceil(self.n * np.maximum(self.shortest_length / lengths.data, 1))
            raise ModelError(
                f"lengthscale must be at least {self.shortest_length.round(3).tolist()}, below "
                f"which {list(self.n)} sines miss more than a tenth of the variance, got "
                f"{lengths.data.tolist()}: take n={needed.astype(int).tolist()}, a longer length "
                "or a smaller box"
            )


def gaussian_process_terms(
    states: str | Sequence[str],
    box: Sequence[Any],
    n: int | Sequence[int],
    *,
    kernel: str = "matern32",
) -> GaussianProcessTerms:
    r"""Make the basis functions of a Gaussian process of one to three states.

    A field in an equation whose form is unknown, such as a force, is a sum of these functions with
    a vector of coefficients, which is a parameter of the equation. Independent normal priors with
    the standard deviations ``basis.prior_sd(lengthscale, amplitude)`` make the field a Gaussian
    process, with an error that falls with ``n`` (see Notes):

    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> basis = psf.mechanics.gaussian_process_terms(["v", "w"], [(-2, 2), (-1, 2)], 8)
    >>> def drift(x, c):
    ...     return [c @ basis(x), 0.1 * x[0]]
    >>> with pm.Model(coords={"term": basis.names}):
    ...     length = pm.InverseGamma("length", 5, 5)
    ...     amplitude = pm.HalfNormal("amplitude", 2)
    ...     c = pm.Normal("c", 0, basis.prior_sd(length, amplitude), dims="term")

    The length of a vector is in ``shapes`` of the `StateSpaceModel`: ``{"c": (len(basis),)}``.

    Parameters
    ----------
    states : str or sequence of str
        Names of the one to three states that the field depends on.
    box : sequence of (low, high)
        The range of the data for each state, in its unit; for one state a pair will do.
    n : int or sequence of int
        Number of sines for each state, or one number for all. The number of functions is their
        product.
    kernel : {"matern32", "matern52", "squared_exponential"}
        Matern with smoothness 3/2 or 5/2, or the squared exponential; the distance is that of
        states divided by their lengths.

    Returns
    -------
    GaussianProcessTerms
        ``basis(x)`` takes the states as a vector or a list; ``basis.names`` and ``len(basis)`` are
        the names and the number of functions: ``"v2 w1"`` has two half waves along ``v``.

    Raises
    ------
    ModelError
        If there are no or more than three states, or an argument is not as described.

    See Also
    --------
    polynomial_terms : Monomials, and functions of your own.
    pymc_statespace_filters.field : The field with its band, from draws of the coefficients.

    Notes
    -----
    The functions vanish at ``basis.boundary``, 1.5 times as wide as the box, with the same centre.
    Beyond it the field is its mirror image with the sign reversed, and means nothing:
    `pymc_statespace_filters.field` warns of states that lie there.

    In the box the standard deviation of the field is that of the kernel, within 2 %, for lengths up
    to a third of half the box, and with enough sines: at ``basis.shortest_length`` they hold 90 %
    of the variance along a state. At the edges it is 7 % too small for a length of half of half the
    box, and 28 to 37 % for one of half the box; a wider box with more sines cures it.

    The sines of one state are computed by a recurrence from one sine and one cosine.

    References
    ----------
    Solin and Särkkä (2020), Statistics and Computing 30, 419-446.

    Riutort-Mayol, Bürkner, Andersen, Solin and Vehtari (2023), Statistics and Computing 33, 17.

    Examples
    --------
    The standard deviation of the field at three points, under a prior of 2:

    >>> basis = psf.mechanics.gaussian_process_terms("z", (-3, 3), 20)
    >>> basis.boundary, basis.shortest_length.round(2)
    (array([[-4.5,  4.5]]), array([0.34]))
    >>> sd = basis.prior_sd(1.0, 2.0)
    >>> values = basis([[-2.0, 0.0, 1.0]])
    >>> (((sd[:, None] * values) ** 2).sum(axis=0) ** 0.5).eval().round(2)
    array([1.99, 1.99, 1.99])
    """
    names = state_names(states)
    d = len(names)
    if d > _MOST_STATES:
        raise ModelError(f"states must name at most {_MOST_STATES} states, got {list(names)}")
    edges = check_floats("box", box, None)
    edges = edges[None] if d == 1 and edges.shape == (2,) else edges
    if edges.shape != (d, 2) or not (edges[:, 0] < edges[:, 1]).all():
        raise ModelError(
            f"box must hold (low, high) with low < high for each of {list(names)}, got {box!r}"
        )
    numbers = list(n) if isinstance(n, Sequence | np.ndarray) else [n] * d
    if len(numbers) != d:
        raise ModelError(f"n must be a number, or one for each of {list(names)}, got {n!r}")
    if kernel not in _KERNELS:
        raise ModelError(f"kernel must be one of {list(_KERNELS)}, got {kernel!r}")
    return GaussianProcessTerms(
        names,
        tuple((float(low), float(high)) for low, high in edges),
        tuple(check_count("n", number, 1) for number in numbers),
        kernel,
    )


def _sines(angle: TensorVariable, n: int, scale: float) -> TensorVariable:
    """``scale * sin(j * angle)`` for j = 1 to n.

    Of a step of a system, by the recurrence of Chebyshev polynomials: its code is written out in
    scalars, where a sine takes as long as twenty products.
    """
    if angle.type.ndim:
        numbers = np.arange(1.0, n + 1).reshape(-1, *[1] * angle.type.ndim)
        return scale * pt.sin(numbers * angle)
    twice_cosine = 2 * pt.cos(angle)
    before, last = pt.zeros_like(angle), scale * pt.sin(angle)
    terms = [last]
    for _ in range(n - 1):
        before, last = last, twice_cosine * last - before
        terms.append(last)
    return pt.stack(terms)
