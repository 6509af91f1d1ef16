"""The user's arguments of a run, checked once: what to draw, and how to execute it.

`SamplingRequest` has all that the draws depend on, apart from the model; `ExecutionOptions` has
threads, ranks and output, on which they do not depend.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from typing import Any, NamedTuple, get_args

import numpy as np
from pymc.model import Model
from pymc.progress_bar import ProgressBarOptions
from pytensor.graph.basic import Variable

from ...errors import ModelError
from ...facts import tell
from ...parallel.ranks import Ranks
from ...pymc_model.fingerprint import (
    FINGERPRINT_DIGITS,
    model_data_fingerprint,
    model_fingerprint,
)
from ...system.checks import check_count, check_flag, check_positive, is_integer
from ..target.settings import RandomWalkSettings
from .continuation import FormerChains

_MOST_ITERATIONS, _MOST_CHAINS = 10**9, 10**4  # whose arrays are too large for a memory
_BARS = get_args(ProgressBarOptions)
DRAWS = 1000  # default of draws, or max_draws if that is less
_MAX_GROWTH = 20  # default of max_draws, in draws


class SamplingRequest(NamedTuple):
    """Arguments of ``sample_dram`` that the draws of a model depend on.

    Those of several models of a run differ in what their pilots determine, at most.
    """

    draws: int
    tune: int
    chains: int
    entropy: list[int]  # of the seed sequence from which each chain spawns its own
    is_seeded: bool  # whether the user gave a seed
    initvals: Any
    keeps_warmup: bool
    proposal_cov: Any
    settings: RandomWalkSettings
    until_ess: float | None = None
    max_draws: int | None = None  # a number if until_ess is
    # Draws of a pilot on the unconstrained space, by rows; None for what it lacks.
    pilot: list[list[float | None]] | None = None
    thin: int = 1  # iterations of which a draw is the last
    # With until_ess: whether thin is doubled, until max_draws iterations, and not more draws made.
    doubles_thin: bool = False
    seconds: float = math.inf  # of processors, that doubling may take
    former: FormerChains | None = None  # that are to go on

    @property
    def n_iterations(self) -> int:
        """Iterations of a chain, warm-up included; the fewest with ``until_ess``."""
        return self.tune + self.draws * self.thin

    @property
    def n_skipped(self) -> int:
        """Iterations of warm-up that are not kept."""
        return 0 if self.keeps_warmup else self.tune

    @property
    def is_centred(self) -> bool:
        """Whether chains may move records in other coordinates than those of the model.

        A given covariance is one in the latter.
        """
        return self.proposal_cov is None if self.former is None else self.former.is_centred

    def with_former(self, positions: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Draws of some chains, by their numbers, each behind those that it is to go on from."""
        if self.former is None:
            return [positions[i] for i in sorted(positions)]
        before = self.former.positions
        return [np.concatenate([before[i], positions[i]]) for i in sorted(positions)]

    def cache_key(self, model: Model, *, require_fingerprint: bool = True) -> dict[str, Any]:
        """Give all that a model's draws depend on, as values of JSON.

        Raises `ModelError` if a part of the model has no text that is the same in every process.
        Without ``require_fingerprint`` the fingerprint of the model is then left empty.
        """
        try:
            fingerprint = model_fingerprint(model)
        except ModelError:
            if require_fingerprint:
                raise
            fingerprint = ""
        return {
            "random_seed": self.entropy if self.is_seeded else None,
            "initvals": _json_value(self.initvals),
            "pilot": self.pilot,
            "draws": int(self.draws),
            "until_ess": self.until_ess,
            "max_draws": self.max_draws,
            "thin": int(self.thin),
            "doubles_thin": self.doubles_thin,
            "continue_from": None if self.former is None else self.former.digest(),
            "tune": int(self.tune),
            "chains": int(self.chains),
            "discard_tuned_samples": not self.keeps_warmup,
            **{f.name: repr(getattr(self.settings, f.name)) for f in fields(self.settings)},
            "proposal_cov": _json_value(self.proposal_cov),
            "model": fingerprint[:FINGERPRINT_DIGITS],
            "data": model_data_fingerprint(model)[:FINGERPRINT_DIGITS],
            "version": version("pymc-statespace-filters"),
        }


class ExecutionOptions(NamedTuple):
    """Arguments of ``sample_dram`` that the draws do not depend on."""

    cores: int | None
    progressbar: bool | str
    compute_convergence_checks: bool
    checks_filters: bool
    ranks: Ranks
    told: Callable[..., Any] = tell  # what becomes of the fact that a run has ended

    @property
    def level(self) -> str:
        """That of the report: who wants no progress bar wants none on the screen either."""
        return "info" if self.progressbar else "debug"

    def check(self) -> None:
        """Raise a `ModelError` if an argument is not as ``sample_dram`` describes it."""
        if not isinstance(self.progressbar, bool) and self.progressbar not in _BARS:
            raise ModelError(
                f"progressbar must be True, False or one of {_BARS}, got {self.progressbar!r}"
            )
        check_flag("compute_convergence_checks", self.compute_convergence_checks)
        check_flag("check", self.checks_filters)
        if self.cores is not None and (not is_integer(self.cores) or self.cores < 1):
            raise ModelError(f"cores must be None or an integer of at least 1, got {self.cores!r}")


@dataclass(frozen=True, kw_only=True, eq=False)  # arrays are not hashable
class RunArguments:
    """What ``sample_dram``, ``run_models`` and ``sample`` all take, as the user gave it."""

    draws: int = DRAWS
    tune: int = 1000
    until_ess: Any = None
    max_draws: Any = None
    thin: int = 1
    chains: int = 4
    cores: int | None = None
    random_seed: Any = None
    initvals: Any = None
    kernel: Any = None
    progressbar: bool | str = True
    discard_tuned_samples: bool = True
    compute_convergence_checks: bool = True
    check: bool = True

    def __post_init__(self) -> None:
        most = self.max_draws
        if self.draws == DRAWS and is_integer(most) and 1 <= most < DRAWS:
            object.__setattr__(self, "draws", int(most))

    def options(self, comm: Any) -> ExecutionOptions:
        """How to execute the run, on the ranks of ``comm``."""
        checks = self.compute_convergence_checks, self.check
        return ExecutionOptions(self.cores, self.progressbar, *checks, Ranks.of(comm))

    def request(self) -> SamplingRequest:
        """Check the arguments that need no model, and make a request of them.

        Raises `ModelError` if an argument is not as ``sample_dram`` describes it.
        """
        draws, tune = self.draws, self.tune
        check_count("draws", draws, 0, _MOST_ITERATIONS)
        check_count("tune", tune, 0, _MOST_ITERATIONS)
        check_count("chains", self.chains, 1, _MOST_CHAINS)
        check_count("thin", self.thin, 1, _MOST_ITERATIONS)
        keeps_warmup = not check_flag("discard_tuned_samples", self.discard_tuned_samples)
        if draws + tune * keeps_warmup == 0:
            raise ModelError(
                f"draws must be at least 1 unless the warm-up is kept, got draws={draws}, "
                f"tune={tune}, discard_tuned_samples={not keeps_warmup}; for the warm-up alone "
                "give discard_tuned_samples=False"
            )
        kernel = RandomWalkSettings.of(self.kernel)
        enough, most = _stopping_rule(draws, self.until_ess, self.max_draws)
        return SamplingRequest(
            draws,
            tune,
            self.chains,
            _entropy(self.random_seed),
            self.random_seed is not None,
            self.initvals,
            keeps_warmup,
            kernel.proposal_cov,
            replace(kernel, proposal_cov=None),
            until_ess=enough,
            max_draws=most,
            thin=int(self.thin),
        )


def _stopping_rule(
    draws: int, until_ess: Any, max_draws: Any
) -> tuple[float, int] | tuple[None, None]:
    """Check ``until_ess`` and ``max_draws``, and fill in the default of the latter."""
    if until_ess is None:
        if max_draws is not None:
            raise ModelError(
                f"max_draws needs until_ess, got max_draws={max_draws!r} alone; without until_ess "
                "each chain makes as many draws as draws says"
            )
        return None, None
    until_ess = check_positive("until_ess", until_ess)
    check_count("draws with until_ess", draws, 1)
    if max_draws is None:
        return until_ess, _MAX_GROWTH * int(draws)
    if not is_integer(max_draws) or max_draws < draws:
        raise ModelError(
            f"max_draws must be an integer of at least draws={draws}, got {max_draws!r}"
        )
    return until_ess, int(max_draws)


def _entropy(random_seed: object) -> list[int]:
    """Turn a seed of PyMC's kinds into the entropy of a run."""
    if random_seed is None:
        return np.random.SeedSequence().generate_state(4).tolist()
    if isinstance(random_seed, np.random.Generator):
        return random_seed.integers(2**32, size=4).tolist()
    if not is_integer(random_seed) or random_seed < 0:
        raise ModelError(
            "random_seed must be None, a non-negative integer or a numpy.random.Generator, got "
            f"{random_seed!r}"
        )
    return [int(random_seed)]


def _json_value(value: Any) -> Any:
    """Convert a value to types that JSON knows."""
    if isinstance(value, Mapping):
        return {str(name): _json_value(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(part) for part in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return np.asarray(value).tolist() if not isinstance(value, Variable) else str(value)
