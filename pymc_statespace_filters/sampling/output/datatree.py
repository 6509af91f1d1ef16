"""Whole chains as the DataTree that ``pm.sample`` returns.

PyMC's converter makes the DataTree, so that groups, dimensions, coordinates, data and
attributes follow its conventions. Its input is traces filled in bulk instead of draw by draw.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from pymc.backends.arviz import dict_to_dataset
from pymc.backends.base import IBaseTrace, MultiTrace
from pymc.model import Model
from xarray import DataTree

from ...errors import ModelError
from ..target.variables import RaveledVariables
from .deterministics import Deterministics

# Groups with draws, and those with statistics of them.
SAMPLE_STATS = {"sample_stats", "warmup_sample_stats"}
# Statistics that do not change after the warm-up.
FROZEN = ("proposal_cov",)
SAMPLED = {"posterior", "warmup_posterior"} | SAMPLE_STATS


# Positions of a chain, shape (n, d), and its statistics by their names in ``sample_stats``, shape
# (n, ...). A statistic that is constant may be a view without a stride, as of `numpy.broadcast_to`.
ChainArrays = tuple[np.ndarray, dict[str, np.ndarray]]


def to_datatree(
    model: Model,
    raveled: RaveledVariables,
    chains: list[ChainArrays],
    *,
    tune: int,
    keep_warmup: bool,
    sampling_time: float,
    stat_dims: Mapping[str, tuple[str, Sequence]] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> DataTree:
    """Convert whole chains to the DataTree that ``pm.sample`` returns.

    Without a group ``posterior`` if no chain finished its warm-up.

    The ``chains`` have warm-up, ``tune`` iterations at the beginning, and draws, of all value
    variables in the order of ``raveled``. The list is emptied, to release memory early. If chains
    were interrupted at different iterations, those are kept, and cut to one length, that give the
    most draws in all. The warm-up is kept in separate groups, if at all. ``stat_dims`` has name and
    coordinates of the dimension of statistics that are vectors, ``attrs`` attributes of the groups
    with draws and statistics, in addition to PyMC's. Raises `ModelError` if no iteration is to be
    kept.
    """
    skipped = 0 if keep_warmup else tune
    lengths = [len(positions) for positions, _ in chains]
    longest, length = most_iterations([length - skipped for length in lengths])
    if length <= 0:
        raise ModelError(
            f"the chains ended after {', '.join(map(str, lengths))} iterations, of which {tune} "
            "are warm-up: there is nothing to return"
        )
    kept = [_cut(chains[i], slice(skipped, skipped + length)) for i in longest]
    chains.clear()
    fixed = [name for name in kept[0][1] if all(_is_fixed(stats[name]) for _, stats in kept)]
    deterministics = Deterministics(model, raveled)
    fixed_stats = {name: np.stack([stats[name][0] for _, stats in kept]) for name in fixed}

    def convert(positions: np.ndarray, stats: dict[str, np.ndarray]) -> DataTree:
        varying = {name: values for name, values in stats.items() if name not in fixed}
        trace = MultiTrace([_ChainTrace(0, deterministics(positions), varying)])
        # There is no public way: PyMC's driver sets these.
        trace.report._n_tune = min(tune, skipped + length)
        trace.report._n_draws = skipped + length - trace.report._n_tune
        trace.report._t_sampling = sampling_time
        return pm.to_inference_data(trace, model=model, save_warmup=keep_warmup)

    # One by one: PyMC's converter needs a multiple of the memory of its input.
    tree = _concatenated([convert(*kept.pop(0)) for _ in longest], attrs or {})
    for name, values in fixed_stats.items():
        _add_fixed(tree, name, values)
    _name_dims(tree, stat_dims or {})
    _store_once(tree)
    return tree


def _cut(chain: ChainArrays, rows: slice) -> ChainArrays:
    positions, stats = chain
    return positions[rows], {name: values[rows] for name, values in stats.items()}


def _concatenated(trees: list[DataTree], attrs: Mapping[str, Any]) -> DataTree:
    """One DataTree from one for each chain."""
    tree = trees[0]
    for group in SAMPLED.intersection(tree.children):
        parts = [of_chain[group].to_dataset() for of_chain in trees]
        for of_chain in trees:
            del of_chain[group]
        whole = xr.concat(parts, "chain", combine_attrs="override")
        tree[group] = DataTree(whole.assign_coords(chain=np.arange(len(parts))))
        tree[group].attrs.update(attrs)
    return tree


class _ChainTrace(IBaseTrace):
    """A whole chain as a trace, the input of PyMC's converter."""

    def __init__(self, chain: int, values: dict[str, np.ndarray], stats: dict[str, np.ndarray]):
        self.chain = chain
        self.varnames = list(values)
        self.sampler_vars = [{name: array.dtype for name, array in stats.items()}]
        self._values, self._stats = values, stats

    def __len__(self) -> int:
        return len(next(iter((self._values | self._stats).values()), ()))

    def get_values(self, varname: str, burn: int = 0, thin: int = 1) -> np.ndarray:
        """Values of a variable."""
        return self._values[varname][burn::thin]

    def get_sampler_stats(
        self, stat_name: str, sampler_idx: int | None = None, burn: int = 0, thin: int = 1
    ) -> np.ndarray:
        """Values of a statistic; there is one sampler."""
        return self._stats[stat_name][burn::thin]

    def _slice(self, idx: slice) -> "_ChainTrace":
        values, stats = (
            {name: array[idx] for name, array in arrays.items()}
            for arrays in (self._values, self._stats)
        )
        return _ChainTrace(self.chain, values, stats)

    def point(self, idx: int) -> dict[str, np.ndarray]:
        """Values of all variables after an iteration."""
        return {name: array[idx] for name, array in self._values.items()}


def most_iterations(lengths: Sequence[int]) -> tuple[list[int], int]:
    """Choose chains and a common length that keep the most iterations, as ``pm.sample`` does."""
    by_length = sorted(range(len(lengths)), key=lambda i: -lengths[i])
    together = [(rank + 1) * lengths[i] for rank, i in enumerate(by_length)]
    last = int(np.argmax(together))
    return sorted(by_length[: last + 1]), lengths[by_length[last]]


def _is_fixed(values: np.ndarray) -> bool:
    return values.ndim > 1 and values.strides[0] == 0


def _add_fixed(tree: DataTree, name: str, values: np.ndarray) -> None:
    """Add a statistic that is constant within a chain, stored once per chain."""
    for group in SAMPLE_STATS.intersection(tree.children):
        n_draws = tree[group].sizes["draw"]
        shape = (len(values), n_draws, *values.shape[1:])
        repeated = np.broadcast_to(values[:, None], shape)
        # There may be fewer draws than chains.
        tree[group].update(dict_to_dataset({name: repeated}, check_conventions=False))


def _store_once(tree: DataTree) -> None:
    """Keep for each chain, not for each draw, what is constant after the warm-up."""
    if "posterior" not in tree.children:
        return
    stats = tree["sample_stats"].to_dataset()
    frozen = {name: stats[name].isel(draw=-1, drop=True) for name in FROZEN if name in stats}
    tree["sample_stats"] = DataTree(stats.assign(frozen))


def _name_dims(tree: DataTree, stat_dims: Mapping[str, tuple[str, Sequence]]) -> None:
    """Name the dimensions of statistics, which PyMC's converter numbers."""
    for group in SAMPLE_STATS.intersection(tree.children):
        stats = tree[group].to_dataset()
        for name, (dim, labels) in stat_dims.items():
            numbered = str(stats[name].dims[-1])
            named = stats[name].drop_vars(numbered).rename({numbered: dim})
            stats = stats.drop_vars([name, numbered]).assign({name: named})
            stats = stats.assign_coords({dim: list(labels)})
        attrs = tree[group].attrs
        tree[group] = DataTree(stats)
        tree[group].attrs.update(attrs)
