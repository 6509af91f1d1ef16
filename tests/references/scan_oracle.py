"""Extended Kalman filter as one PyTensor scan: slow, and differentiable by PyTensor alone.

Its reverse-mode gradient shares no code with the package's and serves as the oracle for it. A
missing component becomes a row of zeros in C with unit noise and zero residual, which adds exactly
nothing; the package removes such rows instead.
"""

from collections.abc import Callable

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.compile.mode import Mode
from pytensor.tensor.variable import TensorVariable

# Interpreted, and without a C compiler: compiling this scan and its gradient takes ten times longer
# than running it.
MODE = Mode(linker="py", optimizer="fast_compile").excluding("BlasOpt")


def value_and_gradient(
    log_likelihood: TensorVariable, parameters: dict[TensorVariable, float]
) -> tuple[float, NDArray[np.float64]]:
    """Value of a scalar expression and its gradient with respect to scalar parameters."""
    gradient = pt.stack(pt.grad(log_likelihood, list(parameters)))
    with pytensor.config.change_flags(cxx=""):
        function = pytensor.function(list(parameters), [log_likelihood, gradient], mode=MODE)
        value, slopes = function(*parameters.values())
    return float(value), np.asarray(slopes)


def ekf_log_likelihood(
    transition: Callable[[TensorVariable], TensorVariable],
    observation: Callable[[TensorVariable], TensorVariable],
    *,
    process_cov: TensorVariable,
    observation_cov: TensorVariable,
    initial_mean: TensorVariable,
    initial_cov: TensorVariable,
    steps: NDArray[np.int64],
    observed: NDArray[np.float64],
) -> TensorVariable:
    """Log-likelihood of x' = transition(x) + w, d = observation(x) + e.

    `transition` and `observation` map a vector to a vector, `process_cov` is (n, n), `observed` is
    (J, p). Every argument but the last two may hold parameters.
    """
    n_steps, (_, p) = int(steps[-1]) + 1, observed.shape
    data = np.full((n_steps, p), np.nan)
    data[steps] = observed

    def one_step(d, total, x, P):
        term, x, P = _update(x, P, d, observation, observation_cov)
        A = _jacobian(transition(x), x)
        return total + term, transition(x), A @ P @ A.T + process_cov

    total, _, _ = pytensor.scan(
        one_step,
        sequences=[pt.as_tensor(data)],
        outputs_info=[
            pt.as_tensor(np.float64(0.0)),
            pt.as_tensor(initial_mean),
            pt.as_tensor(initial_cov),
        ],
        return_updates=False,
    )
    return total[-1]


def _update(x, P, d, observation, observation_cov):
    seen = pt.invert(pt.isnan(d)).astype("float64")
    y = observation(x)
    C = _jacobian(y, x) * seen[:, None]
    R = observation_cov * pt.outer(seen, seen) + pt.diag(1.0 - seen)
    residual = pt.switch(pt.isnan(d), 0.0, d - y)
    S = C @ P @ C.T + R
    K = P @ C.T @ pt.linalg.inv(S)
    log_det = pt.log(pt.linalg.det(S)) + seen.sum() * np.log(2.0 * np.pi)
    term = -0.5 * (log_det + residual @ pt.linalg.inv(S) @ residual)
    return term, x + K @ residual, P - K @ C @ P


def _jacobian(y: TensorVariable, x: TensorVariable) -> TensorVariable:
    """Rows by reverse mode, unrolled over the components of y (its length is static)."""
    rows = [
        pt.grad(y[i], x, disconnected_inputs="ignore", return_disconnected="zero")
        for i in range(y.type.shape[0])
    ]
    return pt.stack(rows)
