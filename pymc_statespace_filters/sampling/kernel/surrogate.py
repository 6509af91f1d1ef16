"""Surrogate transitions: a move made on a cheap density, corrected for the expensive one.

Let K be any kernel reversible for a density c, here delayed rejection on a screen. From y it moves
to z, and the chain goes there with probability (Liu 2001, section 9.4.3)::

    min(1, pi(z) c(y) / (pi(y) c(z)))

For z other than y, pi(y) K(y, z) times this is K(y, z) c(y) min(pi(y) / c(y), pi(z) / c(z)),
which is symmetric in y and z: the chain is reversible for pi, for any c. But points where c is zero
and pi is not are never reached.

References
----------
J. S. Liu (2001). Monte Carlo Strategies in Scientific Computing. Springer.
"""

import numpy as np

from ...compiler.native.jit import linked


@linked()
def log_surrogate_acceptance(
    log_pi_here: float, log_pi_there: float, log_c_here: float, log_c_there: float
) -> float:
    """Log-probability of accepting a move of a kernel reversible for c.

    Parameters
    ----------
    log_pi_here, log_pi_there : float
        Log-density of the target at y and z, up to one constant. May be minus infinity, but not NaN
        or plus infinity.
    log_c_here, log_c_there : float
        Log-density of the surrogate there, likewise.

    Returns
    -------
    float
        In [-inf, 0]; 0/0 counts as zero.

    Examples
    --------
    The surrogate has already accounted for the change of density:

    >>> log_surrogate_acceptance.py_func(0.0, -1.5, 0.0, -1.5)
    0.0
    >>> log_surrogate_acceptance.py_func(0.0, -1.5, 0.0, -1.0)
    -0.5
    """
    if log_pi_there == -np.inf or log_c_here == -np.inf:
        return -np.inf
    return min(0.0, (log_pi_there - log_c_there) - (log_pi_here - log_c_here))
