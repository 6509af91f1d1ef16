"""The manifest of a checkpoint: the settings of its run, in a file that is written once.

A model is identified by what its graphs compute, see `system.graph_digest`. Two builds of a model
agree, in one process or in two.
"""

import json
import os
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import pymc as pm
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.traversal import graph_inputs
from pytensor.tensor.random.type import RandomType

from ...errors import DataMismatchError, ModelError
from ...system.graph_digest import described, digest, graph_digest
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


def model_fingerprint(model: pm.Model) -> str:
    """Hash everything that the draws of a model depend on, except for the numbers in its data.

    The hexadecimal SHA-256 is the same for every build of the model, in every process of the same
    versions of PyMC and PyTensor. It changes with any constant, prior, transform, potential,
    deterministic, name, dimension, coordinate and initial value, with the equations of a
    `StateSpace` and with the settings of its filter. Of observed values and other data it includes
    type and name: see `model_data_fingerprint`. Of a user-defined operation it includes the
    properties or attributes, not the Python code.

    Raises
    ------
    ModelError
        If an operation has an attribute without a text that is the same in every process, such as
        a Python function without a name; the message names both.
    """
    known = {value: digest("value of", rv.name) for rv, value in _roots(model).items()}
    names = {
        "free": [(rv.name, model.rvs_to_values[rv].name) for rv in model.free_RVs],
        "observed": [rv.name for rv in model.observed_RVs],
        "deterministics": [variable.name for variable in model.deterministics],
        "potentials": [variable.name for variable in model.potentials],
        "dims": dict(model.named_vars_to_dims),
        "coords": dict(model.coords),
        "starts": {rv.name: value for rv, value in model.rvs_to_initial_values.items()},
    }
    texts = [described(f"the model's {what}", value) for what, value in names.items()]
    return digest(*texts, graph_digest(_outputs(model), known))


def model_data_fingerprint(model: pm.Model) -> str:
    """Hash all numbers that a model was given as data, with their names.

    The hexadecimal SHA-256 of the names, types and bytes of observed values, of `pymc.Data`, and of
    every other shared variable that the model uses, including the noise seeds of its likelihoods.
    (The ``data_fingerprint`` of an evidence is another one: that of the observed values alone,
    which are the same in rival models, under any name.)
    """
    constants = {
        f"observed {rv.name}": value.data
        for rv, value in _roots(model).items()
        if isinstance(value, Constant)
    }
    used = [v for v in graph_inputs(_outputs(model)) if isinstance(v, SharedVariable)]
    shared = [
        (v.name, v.get_value(borrow=True) if isinstance(v, SharedVariable) else v.data)
        for v in dict.fromkeys([*model.data_vars, *used])
        # Generators are for draws outside the log-density, as in a posterior predictive.
        if not isinstance(v.type, RandomType)
    ]
    return digest(described("the model's data", [constants, shared]))


def _roots(model: pm.Model) -> dict[Variable, Variable]:
    """Values of random variables at which the graphs begin: of free ones, and constants."""
    return {
        rv: model.rvs_to_values[rv]
        for rv in model.basic_RVs
        if model.rvs_to_values[rv].owner is None
        and not isinstance(model.rvs_to_values[rv], SharedVariable)
    }


def _outputs(model: pm.Model) -> list[Variable]:
    return [model.logp(), *model.unobserved_value_vars]
