"""Evidence estimators, one algorithm per file; they see a `Posterior`, not the model."""

from .bridge import Bridge
from .chib_jeliazkov import ChibJeliazkov
from .importance import Importance
from .protocol import Estimate, Estimator

__all__ = [
    "Bridge",
    "ChibJeliazkov",
    "Estimate",
    "Estimator",
    "Importance",
]
