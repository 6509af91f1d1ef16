"""Machine code that a wheel brings along, of functions that know nothing of a user's equations.

A folder for each level of processors, as x86-64-v3, holds files as numba stores them and a
manifest: what they were compiled by, the processor that they were compiled for, and their
checksums. `packaging/machine_code.py` makes the folders. A checkout has none.

Numba's keys cover the sources of a function. So code is loaded only where it is what this process
would compile for a processor of that level, and where its file is whole.
"""

import hashlib
import json
import logging
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from platform import python_implementation
from sysconfig import get_config_var
from typing import Any, NamedTuple

import llvmlite
import numba
import numpy as np
import pytensor
from numba.core.caching import IndexDataCacheFile

FOLDER = Path(__file__).parents[2] / "_machine_code"
MANIFEST = "manifest.json"

_LOG = logging.getLogger("pymc_statespace_filters")


def versions() -> dict[str, str]:
    """The versions on which machine code depends."""
    package = sys.modules[__name__.partition(".")[0]]
    return {
        "python": f"{python_implementation()} {get_config_var('SOABI')}",
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "pytensor": pytensor.__version__,
        "numpy": np.__version__,
        package.__name__: package.__version__,
    }


class ShippedCode(NamedTuple):
    """The files of a level, and the processor that they were compiled for."""

    folder: Path
    target: tuple[str, str, str]  # triple, name and features
    checksums: Mapping[str, str]

    def magic_tuple(self) -> tuple[str, str, str]:
        """The processor, as numba's code generator names it in keys."""
        return self.target

    def load(self, name: str, key: tuple) -> Any:
        """What numba has stored by this name and key; None if there is no such code."""
        stored = IndexDataCacheFile(str(self.folder), name, 0)  # PyTensor's stamp of all sources
        found = stored._load_index().get(key) if self._is_whole(stored._index_name) else None
        return stored._load_data(found) if found and self._is_whole(found) else None

    def _is_whole(self, name: str) -> bool:
        """Whether a file is there, and what was shipped: to read it may be to run it."""
        if name not in self.checksums:
            return False
        with suppress(OSError):
            content = (self.folder / name).read_bytes()
            if hashlib.sha256(content).hexdigest() == self.checksums[name]:
                return True
        _LOG.debug("%s is not the file that was shipped", self.folder / name)
        return False


@cache
def shipped_for(host: tuple[str, str, str]) -> ShippedCode | None:
    """The code of the highest level that runs on a processor; None if there is none.

    ``host`` is numba's tuple of triple, name and features, which a user may have changed by
    variables: code is then shipped only for exactly these.
    """
    is_detected = numba.config.CPU_NAME is None and numba.config.CPU_FEATURES is None
    for path in sorted(FOLDER.glob(f"*/{MANIFEST}"), reverse=True):  # v4 before v3
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            made_by, checksums = manifest["versions"], dict(manifest["checksums"])
            triple, name, features = map(str, manifest["target"])
        except (OSError, ValueError, TypeError, KeyError) as error:
            _LOG.debug("%s cannot be read: %s", path, error)
            continue
        if made_by != versions():
            _LOG.debug("%s is for %s, and not for %s", path, made_by, versions())
            continue
        code = ShippedCode(path.parent, (triple, name, features), checksums)
        has_features = set(features.split(",")) <= set(host[2].split(","))
        if code.target == host or (is_detected and triple == host[0] and has_features):
            return code
        _LOG.debug("%s is for %s, and not for %s", path, code.target, host)
    return None
