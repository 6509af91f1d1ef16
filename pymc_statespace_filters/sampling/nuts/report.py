"""What is said at the end of a run of NUTS."""

from collections.abc import Sequence

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning, WarningType

from ...parallel.signals import is_interrupted
from ..output.convergence import MAX_RHAT
from ..output.remedies import alternatives, reaches_zero, without_transform
from ..output.report import until_ess_warning
from ..output.warnings import sampler_warning
from ..run.request import SamplingRequest
from ..run.stopping import is_enough, remedy_of
from .chains import TOLERATED, NutsChains

# Bayesian fraction of missing information of the energies, below which the tails of one are too
# long for its momenta (Betancourt 2016).
_LEAST_E_BFMI = 0.3


def messages_of(
    model: Model,
    chains: NutsChains,
    missed: Sequence[SamplerWarning],
    request: SamplingRequest,
    names: Sequence[str],
    level: str,
) -> list[SamplerWarning]:
    """A warning for each cause, with those of tails that were missed, and the report."""
    draws = chains.positions.reshape(-1, chains.positions.shape[-1])
    bounded = reaches_zero(model, names, draws)
    instead = None if bounded is None else without_transform(bounded)
    problems = [*_problems(chains, names, instead), *missed]
    if request.until_ess is not None and not is_enough(request, chains.found):
        slowest = names[0] if chains.found is None else names[int(chains.found.rhat.argmax())]
        ways = [instead] if instead else ["use sampler='dram'", f"reparametrise {slowest}"]
        n = chains.length.n_iterations
        if chains.is_stuck:
            remedy = f"more iterations do not help draws that diverge: {alternatives(ways)}"
        else:
            remedy = remedy_of(request, chains.length, chains.found, chains.seconds, ways)
        arguments = request.until_ess, n, chains.seconds, chains.found, names, remedy
        problems.append(until_ess_warning(*arguments))
    text = _report(chains, request, names)
    is_good = chains.found is not None and chains.found.rhat.max() <= MAX_RHAT
    if is_good and not problems and not is_interrupted():
        text += " No problems found."
    return [*problems, SamplerWarning(WarningType.CONVERGENCE, text, level)]


def _report(chains: NutsChains, request: SamplingRequest, names: Sequence[str]) -> str:
    n_chains, n_draws, _ = chains.positions.shape
    behind = "" if chains.length.thin == 1 else f", each the last of {chains.length.thin}"
    found = "" if chains.found is None else f"; {chains.found.described(names)}"
    steps = chains.statistics["n_steps"].mean()
    return (
        f"{n_chains} chains of {n_draws} draws{behind}, after a warm-up of {request.tune}{found}. "
        f"A draw took {steps:.0f} gradients; E-BFMI is at least {_e_bfmi(chains).min():.2f}."
    )


def _problems(
    chains: NutsChains, names: Sequence[str], instead: str | None
) -> list[SamplerWarning]:
    diverging, e_bfmi = chains.statistics["diverging"], _e_bfmi(chains)
    if diverging.mean() > TOLERATED:
        return [
            sampler_warning(
                f"{int(diverging.sum())} of {diverging.size} draws diverged, most where "
                f"{_neck(chains, names)}: "
                f"{instead or "reparametrise that variable, or use sampler='dram'"}."
            )
        ]
    if e_bfmi.min() < _LEAST_E_BFMI:
        return [
            sampler_warning(
                f"E-BFMI is {e_bfmi.min():.2f} in chain {int(e_bfmi.argmin())}: the chains are "
                f"slow along the log-density, as of {_neck(chains, names)}; reparametrise it, or "
                "use sampler='dram'."
            )
        ]
    return []


def _e_bfmi(chains: NutsChains) -> np.ndarray:
    """E-BFMI of each chain."""
    energy = chains.statistics["energy"]
    return np.square(np.diff(energy, axis=1)).mean(axis=1) / energy.var(axis=1)


def _neck(chains: NutsChains, names: Sequence[str]) -> str:
    """The element whose values differ most where draws diverge, or go along with the energy."""
    x = chains.positions.reshape(-1, chains.positions.shape[-1])
    standard = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), np.finfo(float).tiny)
    diverging = chains.statistics["diverging"].ravel()
    if diverging.any():
        means = standard[diverging].mean(axis=0)
        i = int(np.abs(means).argmax())
        return f"{names[i]} is {'large' if means[i] > 0 else 'small'}"
    energy = chains.statistics["energy"].ravel()
    return names[int(np.abs(standard.T @ (energy - energy.mean())).argmax())]
