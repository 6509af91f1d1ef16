"""What a checkpoint is of: a file that is written once, and appears as a whole."""

import json
import os
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint.journal import sync_folder
from pymc_statespace_filters.sampling.checkpoint.lease import PREFIX

FORMAT = "pymc_statespace_filters checkpoint"
VERSION = 1
RUN = "run.json"

_UNFINISHED = "run.json.unfinished"
_LONGEST_SHOWN = 80
_CURE = "delete the folder or give another path"


def begin(folder: Path, asked: str) -> None:
    """Make a checkpoint of an empty folder, or of one that a killed process was about to make."""
    begun = {_UNFINISHED, *(p.name for p in folder.glob(f"{PREFIX}*"))}
    if foreign := sorted(p.name for p in folder.iterdir() if p.name not in begun):
        raise ModelError(
            f"checkpoint={str(folder)!r} is not a checkpoint: it holds {', '.join(foreign[:3])}"
            f"{', ...' if len(foreign) > 3 else ''} but no {RUN}; give another path"
        )
    run = {"format": FORMAT, "version": VERSION, "asked": json.loads(asked)}
    run["sum"] = _sum(run["version"], run["asked"])
    with open(folder / _UNFINISHED, "w", encoding="utf-8") as file:
        json.dump(run, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    os.replace(folder / _UNFINISHED, folder / RUN)
    sync_folder(folder)
    sync_folder(folder.parent)


def compare(folder: Path, asked: str) -> None:
    """Raise unless the folder is a checkpoint of just this."""
    stored, now = _stored(folder), json.loads(asked)
    differing = [
        f"{name}: the checkpoint has {_shown(stored, name)}, asked for {_shown(now, name)}"
        for name in dict.fromkeys([*stored, *now])
        if name not in stored or name not in now or canonical(stored[name]) != canonical(now[name])
    ]
    if differing:
        raise DataMismatchError(
            f"checkpoint={str(folder)!r} is of another run: {'; '.join(differing)}; {_CURE}"
        )


def _stored(folder: Path) -> dict[str, Any]:
    """What the checkpoint was asked for."""
    try:
        run = json.loads((folder / RUN).read_bytes())
        format_, version = run["format"], run["version"]
    except (ValueError, TypeError, KeyError):
        format_, version = None, None
    if format_ != FORMAT or not isinstance(version, int):
        raise ModelError(
            f"checkpoint={str(folder)!r}: its {RUN} is damaged or not of a checkpoint; {_CURE}"
        )
    if version > VERSION:
        raise ModelError(
            f"checkpoint={str(folder)!r} has the format {version}, of a newer version of this "
            f"package, which reads up to {VERSION}: update the package, or give another path"
        )
    asked = run.get("asked")
    if not isinstance(asked, dict) or run.get("sum") != _sum(version, asked):
        raise ModelError(f"checkpoint={str(folder)!r}: its {RUN} is damaged; {_CURE}")
    return asked


def canonical(value: Any) -> str:
    """One text for equal values; it tells 1 from 1.0 and True, and NaN equals itself."""
    return json.dumps(value, sort_keys=True)


def _sum(version: int, asked: dict[str, Any]) -> str:
    return blake2b(canonical([version, asked]).encode(), digest_size=16).hexdigest()


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = canonical(values[name])
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."
