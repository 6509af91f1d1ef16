"""Interacting multiple model filter: a Gaussian for each regime of a system that switches."""

from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.native.plan import Plan
from .ekf import EKF
from .gaussian.base import GaussianFilterBase
from .gaussian.functions import GaussianFilterFunctions
from .iplf import IPLF
from .protocol import System
from .regimes.checks import check_hybrid, check_inner
from .regimes.hybrid import hybrid_of
from .regimes.mixture import mixture_functions
from .regimes.mixture_states import states_plan
from .state_law import StateLaw, law_of_regimes
from .ukf import UKF


@dataclass(frozen=True)
class IMM(GaussianFilterBase):
    """Interacting multiple model filter: for systems that switch between regimes, with a gradient.

    A regime is a state of finitely many values, drawn in ``process_dist`` by `pm.Bernoulli`,
    `pm.Categorical`, `pm.DiscreteUniform` or `pm.Binomial`, or several such states; the other
    states are driven by normal noise. The filter tracks the probability of every regime, and a
    Gaussian of the other states given it, which ``inner`` predicts and updates. After every step
    the Gaussians of all paths that end in the same regime are merged into one Gaussian of the same
    mean and covariance. That is the approximation. The filter is deterministic and has a gradient,
    so NUTS works with it.

    Parameters
    ----------
    inner : EKF, UKF or IPLF
        The filter of the other states given the regime.

    Raises
    ------
    ModelError
        If ``inner`` is another filter.

    Notes
    -----
    Blom and Bar-Shalom (1988), "The interacting multiple model algorithm for systems with Markovian
    switching coefficients", IEEE Transactions on Automatic Control 33, 780-783. Differences: a step
    may depend on the regime before it as well, and is then made for every pair of regimes before
    they are merged. Probabilities of regimes may depend on the other states: they are means over
    the Gaussian, which becomes that of the state given the regime drawn, by quadrature over the
    states on which they depend. It is accurate where they depend smoothly on one linear combination
    of states. Of a probability that jumps, the mean may be wrong by a sixth of the jump.

    The error is small where the observations identify the regime soon. Its size is not known
    beforehand: `check_filter` compares the filter with unbiased ones. `RBPF` is unbiased for
    systems that are linear given the regime. At most 64 transitions between regimes are allowed.

    Examples
    --------
    >>> import pymc as pm
    >>> import pytensor.tensor as pt
    >>> import pymc_statespace_filters as psf
    >>> def noise(x, stay=0.9):
    ...     regime = pm.Bernoulli.dist(pt.switch(x[1] > 0, stay, 1 - stay))
    ...     return [regime, pm.Normal.dist(0, pt.switch(regime > 0, 1.0, 0.2))]
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q: [0.9 * x[0] + q[1], q[0]],
    ...     process_dist=noise,
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.1]],
    ...     initial_dist=lambda: [pm.Normal.dist(0, 1), pm.Bernoulli.dist(0.5)],
    ...     states=["level", "regime"],
    ... )
    >>> terms = psf.log_likelihood(system, psf.IMM(), {}, [0.1, 0.3, 2.0], steps=[1, 2, 3])
    >>> terms.shape
    (3,)
    """

    _: KW_ONLY
    inner: EKF | UKF | IPLF = field(default=EKF())

    def __post_init__(self) -> None:
        check_inner(self.inner)

    def check(self, system: System) -> None:
        """Raise unless the system has regimes, and ``inner`` takes the others given these."""
        check_hybrid("IMM", system, self.inner)

    def is_exact_for(self, system: System) -> bool:
        """Whether there is one regime, and the system linear given it."""
        hybrid = hybrid_of(system.written)
        return len(hybrid.found.step.origin) == 1 and compile_system(hybrid.given).is_linear

    def linearised(self, system: System) -> System:
        """The system of the other states, which is linearised."""
        return compile_system(hybrid_of(system.written).given)

    def is_smooth_for(self, system: System) -> bool:
        """Whether nothing has a kink or jump in states or parameters, given the regimes."""
        return hybrid_of(system.written).is_smooth

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered" or "smoothed" states."""
        hybrid, by = hybrid_of(system.model), self.inner.linearization
        return states_plan(system, hybrid, by, self._functions(system), moment)

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        hybrid = hybrid_of(system.model)
        return law_of_regimes(states, hybrid.regimes, hybrid.order)

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "backward simulation"

    def _functions(self, system: System) -> GaussianFilterFunctions:
        return mixture_functions(system.model, self.inner.linearization)
