"""The distributions of PyMC that systems know, beside the same laws of SciPy."""

import numpy as np
import pymc as pm
from scipy import stats

# Functions of x, and their laws at x = 0.7.
TABLE = {
    "Bernoulli": (lambda x: pm.Bernoulli.dist(logit_p=x), stats.bernoulli(1 / (1 + np.exp(-0.7)))),
    "BetaBinomial": (
        lambda x: pm.BetaBinomial.dist(n=9, alpha=x, beta=2.0),
        stats.betabinom(9, 0.7, 2.0),
    ),
    "Beta": (lambda x: pm.Beta.dist(alpha=x, beta=2.0), stats.beta(0.7, 2.0)),
    "Binomial": (lambda x: pm.Binomial.dist(n=9, p=x), stats.binom(9, 0.7)),
    "DiscreteUniform": (lambda x: pm.DiscreteUniform.dist(x - 0.7, 8), stats.randint(0, 9)),
    "Exponential": (lambda x: pm.Exponential.dist(lam=x), stats.expon(scale=1 / 0.7)),
    "Gamma": (lambda x: pm.Gamma.dist(alpha=2.0, beta=x), stats.gamma(2.0, scale=1 / 0.7)),
    "Geometric": (lambda x: pm.Geometric.dist(p=x), stats.geom(0.7)),
    "Gumbel": (lambda x: pm.Gumbel.dist(mu=x, beta=2.0), stats.gumbel_r(0.7, 2.0)),
    "HalfNormal": (lambda x: pm.HalfNormal.dist(sigma=x), stats.halfnorm(scale=0.7)),
    "InverseGamma": (
        lambda x: pm.InverseGamma.dist(alpha=3.0, beta=x),
        stats.invgamma(3.0, scale=0.7),
    ),
    "Laplace": (lambda x: pm.Laplace.dist(mu=x, b=2.0), stats.laplace(0.7, 2.0)),
    "LogNormal": (
        lambda x: pm.LogNormal.dist(mu=x, sigma=0.4),
        stats.lognorm(0.4, scale=np.exp(0.7)),
    ),
    "Logistic": (lambda x: pm.Logistic.dist(mu=x, s=2.0), stats.logistic(0.7, 2.0)),
    "NegativeBinomial": (
        lambda x: pm.NegativeBinomial.dist(mu=x, alpha=3.0),
        stats.nbinom(3.0, 3.0 / 3.7),
    ),
    "Normal": (lambda x: pm.Normal.dist(mu=x, sigma=2.0), stats.norm(0.7, 2.0)),
    "Poisson": (lambda x: pm.Poisson.dist(mu=x), stats.poisson(0.7)),
    "StudentT": (
        lambda x: pm.StudentT.dist(nu=5.0, mu=x, sigma=2.0),
        stats.t(5.0, loc=0.7, scale=2.0),
    ),
    "Uniform": (lambda x: pm.Uniform.dist(-1.0, x), stats.uniform(-1.0, 1.7)),
    "Weibull": (
        lambda x: pm.Weibull.dist(alpha=1.5, beta=x),
        stats.weibull_min(1.5, scale=0.7),
    ),
}
