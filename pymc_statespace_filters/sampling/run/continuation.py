"""Going on with the chains of a finished run: their states, kept with the draws.

The state of a chain is all that its next iterations depend on, apart from the model: position,
stored estimate with its seeds, frozen proposals, and the key of its random numbers with the number
of iterations made. It is stored once for each chain, in the group ``sampler_state``.
"""

from hashlib import blake2b
from typing import NamedTuple

import numpy as np
import xarray as xr
from pymc.model import Model
from xarray import DataTree

from ...errors import DataMismatchError, ModelError
from ...pymc_model.fingerprint import model_data_fingerprint, model_fingerprint
from ...pymc_model.posterior_draws import STATES, posterior_group, unconstrained_draws
from ..kernel.state import ChainState
from ..output.sample_stats import running_means
from ..target.settings import RandomWalkSettings

_APPENDED = ("posterior", "sample_stats")
# Unsigned words, which not every file format has.
_WORDS = "key"


class FormerChains(NamedTuple):
    """Chains that are to go on: their states, the iterations made, and their draws (n, d)."""

    states: list[ChainState]
    iterations: int
    thin: int
    is_centred: bool  # whether states may have other coordinates than the model
    positions: list[np.ndarray]

    def digest(self) -> str:
        """A text that identifies the states."""
        arrays = [np.ascontiguousarray(array) for state in self.states for array in state]
        content = b"".join(array.tobytes() for array in arrays)
        return blake2b(content, digest_size=8, key=str(self.iterations).encode()).hexdigest()


def stored_states(
    model: Model,
    states: list[ChainState],
    *,
    iterations: int,
    draws: int,
    thin: int,
    is_centred: bool,
    settings: RandomWalkSettings,
) -> DataTree | None:
    """The group of the states of chains; None if they cannot go on from it.

    Noise that chains carry is as long as the record, and is not stored; a model without a text that
    is the same in every process cannot be recognised.
    """
    if any(state.carried.size for state in states) or settings.correlation is not None:
        return None
    try:
        fingerprint = model_fingerprint(model)
    except ModelError:
        return None
    arrays = {
        name: np.stack([getattr(state, name) for state in states])
        for name in ChainState._fields
        if name != "carried"
    }
    arrays[_WORDS] = arrays[_WORDS].view(np.int64)
    data = {name: (("chain", f"{name}_dim"), values) for name, values in arrays.items()}
    attrs = {
        "iterations": int(iterations),
        "draws": int(draws),
        "thin": int(thin),
        "is_centred": int(is_centred),
        "kernel": repr(settings),
        "model": fingerprint,
        "data": model_data_fingerprint(model),
    }
    return DataTree(xr.Dataset(data, {"chain": np.arange(len(states))}, attrs))


def former_chains(
    idata: DataTree, model: Model, settings: RandomWalkSettings, chains: int
) -> FormerChains:
    """The chains of a run of this model, to go on with.

    Raises `ModelError` if the draws are not of chains that can go on, or with other settings;
    `DataMismatchError` if they are of another model or of other data.
    """
    posterior_group(idata)
    if idata.attrs.get("sampler") == "nuts":
        raise ModelError(
            "continue_from must be draws of sampler='dram', got those of NUTS, which cannot go on: "
            "draw again with more draws, or with sampler='dram'"
        )
    if STATES not in idata.children:
        raise ModelError(
            f"continue_from must have the group {STATES!r}, which complete runs of sample and "
            "sample_dram have without correlated noise; draw again, with these draws as pilot of "
            "sample_dram"
        )
    group = idata[STATES].dataset
    _check(group, model, settings, chains)
    arrays = {name: np.ascontiguousarray(group[name].values) for name in group.data_vars}
    arrays[_WORDS] = arrays[_WORDS].view(np.uint64)
    states = [
        ChainState(**{str(name): a[i].copy() for name, a in arrays.items()}, carried=np.empty(0))
        for i in range(chains)
    ]
    n_draws = idata["posterior"].sizes["draw"]
    if n_draws != group.attrs["draws"]:
        raise ModelError(
            f"continue_from must have all draws of its run, {group.attrs['draws']} of each chain, "
            f"got {n_draws}: select from the result"
        )
    positions = list(unconstrained_draws(idata, model))
    iterations, thin = int(group.attrs["iterations"]), int(group.attrs["thin"])
    return FormerChains(states, iterations, thin, bool(group.attrs.get("is_centred")), positions)


def _check(group: xr.Dataset, model: Model, settings: RandomWalkSettings, chains: int) -> None:
    if group.attrs["model"] != model_fingerprint(model):
        raise DataMismatchError("continue_from must be draws of this model, got those of another")
    if group.attrs["data"] != model_data_fingerprint(model):
        raise DataMismatchError("continue_from must be draws with these data, got those of others")
    if group.attrs["kernel"] != repr(settings):
        raise ModelError(
            f"kernel must be as in the run that continue_from is of, {group.attrs['kernel']}, got "
            f"{settings!r}"
        )
    if group.sizes["chain"] != chains:
        raise ModelError(
            f"chains must be that of continue_from, {group.sizes['chain']}, got {chains}"
        )


def appended(former: DataTree, tree: DataTree) -> DataTree:
    """A tree with the draws of another one before its own."""
    for name in _APPENDED:
        parts = [one[name].to_dataset() for one in (former, tree)]
        frozen = [v for v in parts[1].data_vars if "draw" not in parts[1][v].dims]
        whole = xr.concat(
            [part.drop_vars(frozen) for part in parts],
            "draw",
            data_vars="all",
            coords="minimal",
            compat="override",
            join="override",
            combine_attrs="override",
        )
        whole = whole.assign({v: parts[1][v] for v in frozen})
        whole = whole.assign_coords(draw=np.arange(whole.sizes["draw"]))
        if "accept_rate" in whole:  # the mean since the warm-up
            accepted = whole["accepted"]
            whole["accept_rate"] = accepted.copy(data=running_means(accepted.values))
        tree[name] = DataTree(whole)
    seconds = [one["posterior"].attrs.get("sampling_time", 0.0) for one in (former, tree)]
    tree["posterior"].attrs |= {
        "sampling_time": sum(seconds),
        "tuning_steps": former["posterior"].attrs.get("tuning_steps", 0),
    }
    return tree
