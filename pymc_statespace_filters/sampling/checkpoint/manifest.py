"""The manifest of a checkpoint: the settings of its run, in a file that is written once."""

import json
import os
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ...errors import DataMismatchError, ModelError
from .journal import sync_folder
from .lease import PREFIX

_FORMAT = "pymc_statespace_filters checkpoint"
_VERSION = 2
_MANIFEST = "run.json"
_UNFINISHED = "run.json.unfinished"
_MAX_SHOWN = 80  # characters of a value in a message
_CURE = "delete the folder or give another path"


def write_or_compare(folder: Path, settings: str) -> None:
    """Write the manifest of a new checkpoint; raise unless that of an old one has these settings.

    The lease of ``folder`` belongs to this process; a new checkpoint begins in an empty folder.
    ``settings`` are a text made by `canonical`.

    Raises
    ------
    DataMismatchError
        If the settings differ.
    ModelError
        If the folder is something else, or its manifest is damaged or of another format.
    """
    if not (folder / _MANIFEST).exists():
        _write(folder, settings)
        return
    stored, now = _read(folder), json.loads(settings)
    differing = [
        f"{name}: the checkpoint has {_shown(stored, name)}, this run has {_shown(now, name)}"
        for name in dict.fromkeys([*stored, *now])
        if name not in stored or name not in now or canonical(stored[name]) != canonical(now[name])
    ]
    if differing:
        raise DataMismatchError(
            f"checkpoint={str(folder)!r} is of another run: {'; '.join(differing)}; {_CURE}"
        )


def canonical(value: Any) -> str:
    """One text for equal JSON values; 1, 1.0 and True differ, NaN equals itself."""
    return json.dumps(value, sort_keys=True)


def _write(folder: Path, settings: str) -> None:
    known = {_UNFINISHED, *(path.name for path in folder.glob(f"{PREFIX}*"))}
    if foreign := sorted(path.name for path in folder.iterdir() if path.name not in known):
        raise ModelError(
            f"checkpoint={str(folder)!r} is not a checkpoint: it holds {', '.join(foreign[:3])}"
            f"{', ...' if len(foreign) > 3 else ''} but no {_MANIFEST}; give another path"
        )
    run = {"format": _FORMAT, "version": _VERSION, "settings": json.loads(settings)}
    run["checksum"] = _checksum(run["settings"])
    with open(folder / _UNFINISHED, "w", encoding="utf-8") as file:
        json.dump(run, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    os.replace(folder / _UNFINISHED, folder / _MANIFEST)
    sync_folder(folder)
    sync_folder(folder.parent)


def _read(folder: Path) -> dict[str, Any]:
    """The settings in the manifest."""
    try:
        run = json.loads((folder / _MANIFEST).read_bytes())
        format_, version = run["format"], run["version"]
    except (ValueError, TypeError, KeyError):
        format_, version = None, None
    if format_ != _FORMAT or not isinstance(version, int):
        raise ModelError(
            f"checkpoint={str(folder)!r}: its {_MANIFEST} is damaged or not of a checkpoint; "
            f"{_CURE}"
        )
    if version != _VERSION:
        raise ModelError(
            f"checkpoint={str(folder)!r} has the format {version} of another version of this "
            f"package, which reads the format {_VERSION}: use that version, or {_CURE}"
        )
    settings = run.get("settings")
    if not isinstance(settings, dict) or run.get("checksum") != _checksum(settings):
        raise ModelError(f"checkpoint={str(folder)!r}: its {_MANIFEST} is damaged; {_CURE}")
    return settings


def _checksum(settings: dict[str, Any]) -> str:
    return blake2b(canonical(settings).encode(), digest_size=16).hexdigest()


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = canonical(values[name])
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
