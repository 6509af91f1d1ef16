"""Evidence estimators, one algorithm per file; they see a `Posterior`, not the model."""

from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.estimators.importance import Importance
from pymc_statespace_filters.evidence.estimators.laplace import Laplace
from pymc_statespace_filters.evidence.estimators.prior_monte_carlo import PriorMonteCarlo
from pymc_statespace_filters.evidence.estimators.protocol import Estimate, Estimator
from pymc_statespace_filters.evidence.estimators.tempered_smc import TemperedSMC

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
