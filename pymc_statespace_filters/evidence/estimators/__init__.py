"""Evidence estimators, one algorithm per file; they see a `Posterior`, not the model."""

from .bridge import Bridge
from .chib_jeliazkov import ChibJeliazkov
from .importance import Importance
from .laplace import Laplace
from .prior_monte_carlo import PriorMonteCarlo
from .protocol import Estimate, Estimator
from .tempered_smc import TemperedSMC

__all__ = [
    "Bridge",
    "ChibJeliazkov",
    "Estimate",
    "Estimator",
    "Importance",
    "Laplace",
    "PriorMonteCarlo",
    "TemperedSMC",
]
