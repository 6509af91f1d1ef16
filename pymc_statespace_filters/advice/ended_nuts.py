"""What is said at the end of a run of NUTS: each cause once, and the report."""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri

from ..parallel.signals import is_interrupted
from ..pymc_model.inspection import have_missing_codes
from ..sampling.output.convergence import MAX_RHAT
from ..sampling.output.facts import EndedNuts
from .filter_check import filters_of
from .mirrors import of_one_image
from .missed import missed_of
from .mixing import mixing_problem, until_ess_problem
from .remedies import alternatives, reaches_zero, reparametrise, without_transform
from .words import log, told

# Bayesian fraction of missing information of the energies, below which the tails of one are too
# long for its momenta (Betancourt 2016).
_LEAST_E_BFMI = 0.3
# A variable is named for divergences that have nothing to do with any with this probability, and
# never if its mean where draws diverge differs by less, in standard deviations.
_BY_CHANCE, _LEAST_SHIFT = 0.05, 0.5


@told.register
def _(fact: EndedNuts, begin: str) -> list[str]:
    missed, alike = missed_of(fact)
    check = filters_of(fact)
    bounded = reaches_zero(fact.model, fact.names, fact.positions)
    instead = "" if bounded is None else without_transform(bounded)
    too_short = of_one_image(_too_short(alike, instead), alike is not fact)
    said = [*_problems(fact, instead), *missed, *too_short]
    report = _report(fact)
    is_good = fact.convergence is not None and fact.convergence.rhat.max() <= MAX_RHAT
    if is_good and not (said or is_interrupted() or have_missing_codes(fact.model)):
        report += " No problems found."
    log([begin + text for text in said])
    log([begin + report], fact.options.level)
    check.tell(fact.options.level, begin)
    return [*said, *check.warned]


def _too_short(fact: EndedNuts, instead: str) -> list[str]:
    """Draws that are worth less than was asked for."""

    def ways(slowest: str) -> list[str]:
        return [instead or reparametrise(fact.names, fact.positions, slowest)]

    remedy = ""
    if fact.is_stuck:
        slowest = fact.names[0 if fact.convergence is None else int(fact.convergence.rhat.argmax())]
        remedy = f"more iterations do not help draws that diverge: {alternatives(ways(slowest))}"
    if fact.is_complete:
        text = until_ess_problem(fact, ways, remedy)
    else:  # the user has ended them
        text = mixing_problem(fact, ways)
    return [] if text is None else [text]


def _report(fact: EndedNuts) -> str:
    n_chains, n_draws = fact.diverging.shape
    chains = "1 chain" if n_chains == 1 else f"{n_chains} chains"
    behind = "" if fact.length.thin == 1 else f", each the last of {fact.length.thin}"
    found = "" if fact.convergence is None else f"; {fact.convergence.described(fact.names)}"
    return (
        f"{chains} of {n_draws} draws{behind}, after a warm-up of {fact.request.tune}"
        f"{found}. A draw took {fact.n_steps.mean():.0f} gradients; E-BFMI is at least "
        f"{_e_bfmi(fact).min():.2f}."
    )


def _problems(fact: EndedNuts, instead: str) -> list[str]:
    diverging, e_bfmi = fact.diverging, _e_bfmi(fact)
    if fact.diverges:
        many = f"{int(diverging.sum())} of {diverging.size} draws diverged"
        if neck := where_diverging(fact.names, fact.positions, diverging.ravel()):
            return [f"{many}, most where {neck}: {instead or 'reparametrise that variable'}."]
        missed = f"about {100 * diverging.mean():.2g} % of the posterior may be missing from them"
        return [f"{many}, where no single variable is large or small: {instead or missed}."]
    if e_bfmi.min() < _LEAST_E_BFMI:
        return [
            f"E-BFMI is {e_bfmi.min():.2f} in chain {int(e_bfmi.argmin())}: the chains are slow "
            f"along the log-density, as of {_along_energy(fact)}; reparametrise it."
        ]
    return []


def _e_bfmi(fact: EndedNuts) -> np.ndarray:
    """E-BFMI of each chain."""
    energy = fact.energy
    return np.asarray(np.square(np.diff(energy, axis=1)).mean(axis=1) / energy.var(axis=1))


def where_diverging(names: Sequence[str], x: np.ndarray, diverging: np.ndarray) -> str:
    """The element of draws (n, k) that differs most where they diverge, if not by chance."""
    means = _standard(x)[diverging].mean(axis=0)
    i = int(np.abs(means).argmax())
    by_chance = -ndtri(_BY_CHANCE / 2 / len(names)) / np.sqrt(diverging.sum())
    if np.abs(means[i]) < max(by_chance, _LEAST_SHIFT):
        return ""
    return f"{names[i]} is {'large' if means[i] > 0 else 'small'}"


def _along_energy(fact: EndedNuts) -> str:
    """The element whose values go along with the energy most."""
    energy = fact.energy.ravel()
    along = _standard(fact.positions).T @ (energy - energy.mean())
    return fact.names[int(np.abs(along).argmax())]


def _standard(x: np.ndarray) -> np.ndarray:
    """Draws in units of their standard deviations."""
    return np.asarray((x - x.mean(axis=0)) / np.maximum(x.std(axis=0), np.finfo(float).tiny))
