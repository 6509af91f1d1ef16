"""Which observations carry the variance of an estimated log-likelihood."""

import numpy as np

# The observations named carry this share of the variance together, if so many are enough.
_SHARE, _MOST = 0.5, 5
# A variance is concentrated if one in so many observations carries half of it.
_ONE_IN = 50


def noisiest_terms(terms: np.ndarray) -> dict[int, float]:
    """The rows of the record with the largest shares of the variance, and these shares.

    Estimates (R, J) of all terms. The share of a term is its covariance with the total, over the
    variance of the total: shares add up to one.
    """
    finite = terms[np.isfinite(terms).all(axis=1)]
    centred = finite - finite.mean(axis=0) if len(finite) else finite
    totals = centred.sum(axis=1)
    variance = float(totals @ totals)
    if not variance > 0.0:
        return {}
    shares = totals @ centred / variance
    order = np.argsort(-shares)[:_MOST]
    n_needed = 1 + int(np.searchsorted(np.cumsum(shares[order]), _SHARE))
    return {int(j): float(shares[j]) for j in order[:n_needed] if shares[j] > 0.0}


def is_concentrated(noisiest: dict[int, float], n_terms: int) -> bool:
    """Whether a fiftieth of the observations, or a single one, carries half of the variance."""
    return len(noisiest) <= max(1, n_terms // _ONE_IN) and sum(noisiest.values()) >= _SHARE


def describe(noisiest: dict[int, float]) -> str:
    """Say which observations carry which share of the variance."""
    rows = ", ".join(f"{j} ({100 * share:.0f} %)" for j, share in noisiest.items())
    return f"By rows of the record, from 0, the largest shares of the variance are {rows}"
