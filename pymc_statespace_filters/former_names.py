"""Old names, of the package, of estimators and of arguments: errors that say what to use now."""

from collections.abc import Callable
from functools import wraps

_MOVED = {
    "compartments": "euler_multinomial gamma_white_noise",
    "diagnostics": "drift_scan",
    "errors": "CheckpointError CheckpointWarning DataMismatchError EvidenceWarning FilterWarning "
    "GradientUnavailableError LoweringError ModelError ParallelError ParallelWarning "
    "StateSpaceFiltersError",
    "evidence": "Evidence",
    "mechanics": "cubic freeplay hysteresis hysteresis_branch second_order",
    "point_estimation": "MaximumLikelihoodEstimate",
    "system": "stationary",
}
PLACES = frozenset(_MOVED)

NAMES = {
    name: f"has moved to pymc_statespace_filters.{place}.{name}"
    for place, names in _MOVED.items()
    for name in names.split()
} | {
    "DimensionCorrection": "has gone: give compare_evidence a model_prior",
    "RandomWalkSettings": 'has gone: kernel= takes a mapping, such as {"stages": 1}',
    "Ranks": 'has gone: comm= takes a mapping, such as {"per_chain": 2, "gather": "all"}',
    "compare_prequential": 'has gone: use compare_evidence(results, by="row")',
    "linear_modes": "has gone: the how-to on validation has it in ten lines",
    "marginal_modes": "has gone: use arviz.mode",
    "plot_phase": "has gone: plot a state of idata['smoothed_states'] against another",
    "plot_predictive": 'has gone: use plot_forecast(idata, group="posterior_predictive")',
    "relevance": "has gone: use select_terms",
}

FORMER_ESTIMATORS = {
    "laplace": "has gone: use 'bridge' or 'importance', whose errors are known",
    "prior_monte_carlo": "has gone: use the evidence of sample_smc, which needs no draws",
    "tempered_smc": "has gone: use the evidence of sample_smc, which needs no draws",
    "warp_bridge": "has gone: use 'bridge', or 'importance' for skewed posteriors",
}

_OF_DRAM = "stages stage_scale adaptation adapt_every refresh_noise correlation screen screen_power"
_OF_CHAINS = {
    name: f'give kernel={{"{name}": ...}}' for name in f"{_OF_DRAM} proposal_cov".split()
} | {name: f'give comm={{"{name}": ...}}' for name in ("per_chain", "gather")}
_ONE_RECORD = {"records": "give record=, the label of one"}
_RECORDS = {"record": "give records=, a label or several"}
_ARGUMENTS = {
    "compare_evidence": {
        "prior": "give model_prior=",
        "correction": "give model_prior=, proportional to J^(-k alpha / 2) for k parameters",
    },
    "sample_dram": _OF_CHAINS,
    "run_models": _OF_CHAINS,
    "suggest_particles": {
        "var_name": "the table has a row for every noisy variable",
        "max_seconds": "it measures two numbers of particles and ends",
    },
    "plot_drift": _ONE_RECORD,
    "plot_filter_health": _ONE_RECORD,
    "plot_residuals": _ONE_RECORD,
    "plot_forecast": _RECORDS,
    "plot_states": _RECORDS,
}


def former_names[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Refuse the arguments that a public function once had, or that its relatives have.

    The function returned raises a `TypeError` if it is called with such a name.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.compare_evidence({}, prior={})
    Traceback (most recent call last):
    TypeError: compare_evidence() has no argument 'prior': give model_prior=
    """
    instead = _ARGUMENTS[function.__name__]

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        for name in kwargs:
            if name in instead:
                raise TypeError(f"{function.__name__}() has no argument {name!r}: {instead[name]}")
        return function(*args, **kwargs)

    return checked
