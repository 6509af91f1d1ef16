"""Expected information from likelihoods of simulated records at draws: NumPy, without a model.

Record r of a model is made by draw r mod n of its n draws, and draw j belongs to group j mod G. All
that is known of a record are its log-likelihood at the draw that made it, and the log-sums of its
likelihoods over the other draws of each group, of every model. From these follow the estimates with
all draws, without any one group, and with the even or the odd groups alone.

Errors are those of the delete-a-group jackknife. It leaves out the draws of a group, of all models,
together with the records that they made, and so covers the records, the draws that all records have
in common, and their covariance.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.float64]

MODEL, PARAMETERS, DECIDED, MISLED = "model", "parameters", "decided", "misled"
INVERSE = "inverse"


class Records(NamedTuple):
    """What is known of R records of each of M models, under one design.

    ``own`` (M, R), NaN for a record that is left out; ``sums`` (M, R, M, G), without the draw that
    made the record; and the number of draws of each model, ``n_draws`` (M,).

    For the information about some variables alone, ``sums`` are (M, R, M + 1, G). The last are over
    draws of the record's own model, with the values of these variables that made the record.
    """

    own: Array
    sums: Array
    n_draws: NDArray[np.int64]


def group_sums(values: Array, n_groups: int) -> Array:
    """Log-sums (..., G) of the exponentials of values (..., n) over j mod G."""
    *others, n = values.shape
    padded = np.full((*others, -(-n // n_groups) * n_groups), -np.inf)
    padded[..., :n] = values
    return np.asarray(np.logaddexp.reduce(padded.reshape(*others, -1, n_groups), axis=-2))


class Estimate(NamedTuple):
    """A number by all draws, its standard error, and its change from half as many draws."""

    value: float
    se: float
    change: float


def estimate(replicates: Array) -> Estimate:
    """The estimate of replicates (G + 3,): all, without each group, even groups, odd groups."""
    value, without, halves = replicates[0], replicates[1:-2], replicates[-2:]
    factor = (len(without) - 1) / len(without)
    with np.errstate(invalid="ignore"):  # infinite where all other draws exclude a record
        se = np.sqrt(factor * ((without - without.mean()) ** 2).sum())
        return Estimate(float(value), float(se), float(value - halves.mean()))


def estimate_of_share(replicates: Array, n_records: int) -> Estimate:
    """The same of a share of the records, whose error is not below that of a proportion.

    The jackknife has none where all records agree; then the error is that of Laplace's rule.
    """
    found = estimate(replicates)
    share = (found.value * n_records + 1) / (n_records + 2)
    least = np.sqrt(share * (1 - share) / (n_records + 3))
    return found._replace(se=float(max(found.se, least)))


def replicates(records: Records, weights: Array, odds: float) -> dict[str, Array]:
    """Every quantity (G + 3,) by its name, in nats, for prior probabilities of the models.

    ``parameters_low[i]``, ``parameters_high[i]``
        Information about the parameters of model i: with the draw that made the record among those
        of its evidence (contrastive, a lower bound), and without it (nested, an upper bound). About
        some variables, the likelihood given these is a mean, too: without that draw in the lower
        bound, and with it in the upper one.
    ``model_low``, ``model_high``
        Information about which model: E log q(m | y) plus the entropy of the weights, by evidences
        without that draw (a lower bound), and with it in the evidence of the true model.
    ``log_bf[i, j]``
        Expected log Bayes factor of model i against j, if i is true; without that draw.
    ``decided[i]``, ``misled[i]``
        If i is true: the probability that its posterior odds against all others together are above
        ``odds``, and that those of a wrong model are. Without index, over all models.

    ``inverse[i]``
        Log of the mean over records of the evidence without the draw that made the record over the
        likelihood at it. The mean is expected to be 1 whatever the draws are, if the likelihood is
        that of the records.

    ``parameters[i]`` and ``model`` are in the middle between low and high.
    """
    with np.errstate(invalid="ignore"):
        return dict(_quantities(records, weights, odds))


def _quantities(records: Records, weights: Array, odds: float) -> Iterator[tuple[str, Array]]:
    n_models, n_groups = records.sums.shape[0], records.sums.shape[-1]
    members = np.vstack(
        [np.ones(n_groups), 1 - np.eye(n_groups), *(np.arange(n_groups) % 2 == i for i in (0, 1))]
    )
    evidences = [_evidences(records, members, i) for i in range(n_models)]
    for i, (without, including, lowest, highest, kept) in enumerate(evidences):
        low, high = _mean(lowest - including, kept), _mean(highest - without[:, i], kept)
        yield from _between(PARAMETERS, low, high, f"[{i}]")
        ratios = np.where(kept > 0, without[:, i] - lowest, -np.inf)
        yield f"{INVERSE}[{i}]", logsumexp(ratios, axis=0) - np.log(kept.sum(axis=0))
    if n_models == 1:
        return
    entropy = -(weights * np.log(weights)).sum()
    about = np.zeros((2, len(members)))
    shares: dict[str, Array] = {DECIDED: np.zeros(len(members)), MISLED: np.zeros(len(members))}
    for i, (without, including, *_, kept) in enumerate(evidences):
        joint = without + np.log(weights)[:, None]
        with_own = joint.copy()
        with_own[:, i] = including + np.log(weights[i])
        for k, each in enumerate((joint, with_own)):
            log_q = each[:, i] - logsumexp(each, axis=1)
            about[k] += weights[i] * (_mean(log_q, kept) + entropy)
        for j in range(n_models):
            if j != i:
                yield f"log_bf[{i}, {j}]", _mean(without[:, i] - without[:, j], kept)
        passes = _log_odds(joint) > np.log(odds)
        is_right = np.arange(n_models) == i
        for name, models in ((DECIDED, is_right), (MISLED, ~is_right)):
            share = _mean(passes[:, models].any(axis=1).astype(float), kept)
            shares[name] += weights[i] * share
            yield f"{name}[{i}]", share
    yield from _between(MODEL, *about)
    yield from shares.items()


def _evidences(records: Records, members: Array, i: int) -> tuple[Array, ...]:
    """Of the R records of model i that are kept, with each of S sets of groups.

    Log-evidences of all models without the draw that made the record (R, M, S), that of the model
    with it (R, S), the least and the greatest log-likelihood given the parameters asked about
    (R, 1 or S), and whether the record counts (R, S).
    """
    (n_models, _, n_sums, n_groups), n = records.sums.shape, records.n_draws
    counts = np.array([group_counts(size, n_groups) for size in n])[[*range(n_models), i][:n_sums]]
    numbers = np.flatnonzero(~np.isnan(records.own[i]))
    groups = numbers % n[i] % n_groups
    sums = _log_sums(records.sums[i, numbers])
    n_in = np.broadcast_to(counts @ members.T, sums.shape).copy()
    of_own = [i, *range(n_models, n_sums)]
    n_in[:, of_own] -= members.T[groups][:, None]
    own = records.own[i, numbers, None]
    including = np.logaddexp(sums[:, of_own], own[:, None]) - np.log(n_in[:, of_own] + 1)
    without = sums - np.log(n_in)
    kept = members.T[groups].copy()
    kept[:, -2:] = 1.0  # half of the draws, and all records
    given = (own, own) if n_sums == n_models else (without[:, -1], including[:, -1])
    return without[:, :n_models], including[:, 0], *given, kept


def group_counts(n: int, n_groups: int) -> NDArray[np.int64]:
    """How many of n draws each group has."""
    return np.bincount(np.arange(n) % n_groups, minlength=n_groups)


def _log_sums(sums: Array) -> Array:
    """Sums (..., G) of groups over all, without each, and over even and odd groups, (..., G + 3).

    Without subtraction: one group may have nearly all of the sum.
    """
    up = np.logaddexp.accumulate(sums, axis=-1)
    down = np.logaddexp.accumulate(sums[..., ::-1], axis=-1)[..., ::-1]
    nothing = np.full((*sums.shape[:-1], 1), -np.inf)
    before = np.concatenate([nothing, up[..., :-1]], axis=-1)
    after = np.concatenate([down[..., 1:], nothing], axis=-1)
    halves = [np.logaddexp.reduce(sums[..., k::2], axis=-1, keepdims=True) for k in (0, 1)]
    return np.concatenate([up[..., -1:], np.logaddexp(before, after), *halves], axis=-1)


def _log_odds(joint: Array) -> Array:
    """The log-odds of each model against all others together, for values (R, M, S)."""
    models = range(joint.shape[1])
    others = [logsumexp(np.delete(joint, i, axis=1), axis=1) for i in models]
    return joint - np.stack(others, axis=1)


def _mean(values: Array, kept: Array) -> Array:
    """Means over the records (R, S) that count."""
    return np.asarray(np.where(kept > 0, values, 0.0).sum(axis=0) / kept.sum(axis=0))


def _between(name: str, low: Array, high: Array, index: str = "") -> Iterator[tuple[str, Array]]:
    # Above, without a bound where all other draws exclude a record, low is what is known.
    yield f"{name}{index}", np.where(np.isposinf(high), low, (low + high) / 2)
    yield f"{name}_low{index}", low
    yield f"{name}_high{index}", high


def best_first(replicated: Mapping[str, Array]) -> tuple[list[str], dict[str, Estimate]]:
    """Names in the order of their values, and the difference of each from the first."""
    values = {name: own[0] for name, own in replicated.items()}
    order = sorted(values, key=lambda name: (np.isnan(values[name]), -values[name]))
    first = replicated[order[0]]
    with np.errstate(invalid="ignore"):
        return order, {name: estimate(replicated[name] - first) for name in order}
