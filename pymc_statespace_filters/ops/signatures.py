"""Arguments and results of the functions that a filter computes, for one record or for several."""

from typing import NamedTuple

type Names = tuple[tuple[str, int], ...]


class Signature(NamedTuple):
    """Names and dimensions, see `compiler.native.plan`, for a single record."""

    arguments: Names
    results: Names


class Form(NamedTuple):
    """Which records an evaluation has, by the arguments and results with one more dimension."""

    name: str
    longer: tuple[str, ...] = ()

    def of(self, names: Names) -> Names:
        """Names and dimensions in this form."""
        return tuple((name, ndim + (name in self.longer)) for name, ndim in names)


ONE_RECORD = Form("one record")
POINTS = Form("points", ("theta", "terms", "health", "state"))
"""One record at many points: theta (B, k), state (B, S) -> terms (B, J), health (B, 3)."""
PANEL = Form("panel", ("theta", "steps", "theta_bar"))
"""All records of a panel, see `system.record`: theta (G, k), rows (J, 3) -> terms (J,), health
(3,).

Health is that of the whole panel: the smallest effective number of particles, and code and row of
the first failing record. A record that fails has terms of -inf, the others keep theirs.
"""

RECORD: Names = (("theta", 1), ("steps", 1), ("observed", 2), ("inputs", 2), ("t0", 0))
SEEDED: Names = (*RECORD, ("seed", 0))
_TERMS, _HEALTH, _TAPE, _TERMS_BAR = ("terms", 1), ("health", 1), ("tape", 2), ("terms_bar", 1)

LIKELIHOOD = Signature(SEEDED, (_TERMS, _HEALTH))
TAPED = Signature(SEEDED, (_TERMS, _HEALTH, _TAPE))
PULLBACK = Signature((*SEEDED, _TAPE, _TERMS_BAR), (("theta_bar", 1),))
GRADIENT = Signature((*SEEDED, _TERMS_BAR), (("theta_bar", 1),))
"""Vector-Jacobian product: the cotangent of theta (k,) from that of the terms (J,)."""
TERM_HEALTH = Signature(SEEDED, (_TERMS, ("n_effective", 1), _HEALTH))
"""A term is the log of a mean over members, and n_effective (J,) is that of the weights of this
mean; NaN where there is no term."""
STATES = Signature(
    (*SEEDED, ("wanted", 1), ("draw_seed", 0)),
    (("mean", 2), ("sd", 2), ("drawn", 2), ("n_effective_wanted", 1), _HEALTH),
)
"""Mean, sd and a draw (R, n) of the state at the steps ``wanted``; n_effective (R,); and health.
The draws of one ``draw_seed`` belong together. From a failing observation on all are NaN."""
RUN = Signature(
    (*SEEDED, ("wanted", 1), ("state", 1)),
    (_TERMS, _HEALTH, ("mean", 2), ("cov", 3), ("members", 3), ("weights", 2), ("state", 1)),
)
"""Terms, health, and the state at the steps ``wanted``, given the observations up to each: mean
(R, n), covariance (R, n, n), members (R, N, n) and weights (R, N); N is 0 without members. The
``state`` is that of the filter, empty at the start, and the one that it leaves."""
GOING_ON = Signature((*RECORD, ("state", 1)), (_TERMS, _HEALTH, ("state", 1)))
"""The likelihood of rows from a state of a deterministic filter, with the state that it leaves."""
PREDICTIONS = Signature(
    SEEDED, (("predicted", 2), ("predicted_cov", 3), ("log_below", 2), ("log_above", 2))
)
"""The law of every observation given those before it: mean (J, p), covariance (J, p, p), and the
logs (J, p) of the probabilities that a component is below and above what was observed. NaN for a
missing component, and from a failure on."""
NORMALS = Signature((("steps", 1), ("seed", 0)), (("normals", 1),))
