"""Machine code that comes with a wheel: loaded where it is right, else compiled."""

import json
import logging
import os
import runpy
import subprocess
import sys
from ctypes import CFUNCTYPE, c_void_p
from pathlib import Path
from types import FunctionType
from uuid import uuid4

import numpy as np
import pytest
from numba import carray
from numba.core.codegen import CPUCodegen
from numba.core.registry import cpu_target
from pytensor.link.numba import cache as pytensor_cache

from pymc_statespace_filters.compiler.native import entry_point, shipped_code
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint
from tests.waiting import LIMIT

PACKAGING = Path(__file__).parents[3] / "packaging"
MACHINE_CODE = runpy.run_path(str(PACKAGING / "machine_code.py"))
HOST = cpu_target.target_context.codegen().magic_tuple()
SOME_FEATURES = ",".join(HOST[2].split(",")[:5])


def _double(x):
    values = carray(x, (1,))
    values[0] *= 2.0


class Wheel:
    """A function whose machine code is in a folder as that of a wheel, and an empty cache."""

    def __init__(self, path, monkeypatch, target=HOST):
        self._path, self._monkeypatch = path, monkeypatch
        inside = FunctionType(
            _double.__code__, {"__name__": entry_point.__name__, "carray": carray}, "_double"
        )
        self._point = EntryPoint(inside, {"x": F64_PTR}, "double", (uuid4().hex,))
        self.folder = path / "shipped" / "level"
        monkeypatch.setattr(shipped_code, "FOLDER", path / "shipped")
        monkeypatch.setattr(shipped_code.numba.config, "CPU_NAME", None)
        monkeypatch.setattr(shipped_code.numba.config, "CPU_FEATURES", None)
        with monkeypatch.context() as compiled:
            compiled.setattr(CPUCodegen, "magic_tuple", lambda codegen: target)
            assert self.is_compiled("first")
            MACHINE_CODE["keep"](self.folder, "numbers")
        self.manifest = self.folder / shipped_code.MANIFEST

    def is_compiled(self, cache="second"):
        """Whether the function, which gives the right number, was compiled into an empty cache."""
        folder = self._path / cache
        folder.mkdir()
        self._monkeypatch.setattr(pytensor_cache, "NUMBA_CACHE_PATH", folder)
        shipped_code.shipped_for.cache_clear()
        entry_point._compiled.pop(self._point.symbol, None)
        self._point.compile()
        number = np.array([3.0])
        CFUNCTYPE(None, c_void_p)(self._point.address)(number.ctypes.data)
        assert number[0] == 6.0
        return bool(list(folder.iterdir()))

    def change(self, **entries):
        """Write other entries into the manifest."""
        manifest = json.loads(self.manifest.read_text())
        self.manifest.write_text(json.dumps(manifest | entries))


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    yield Wheel(tmp_path, monkeypatch)
    shipped_code.shipped_for.cache_clear()


def test_code_of_the_wheel_is_not_compiled(wheel):
    assert not wheel.is_compiled()


@pytest.mark.parametrize("of", shipped_code.versions())
def test_code_of_another_version_is_not_loaded(wheel, of):
    wheel.change(versions=shipped_code.versions() | {of: "0.0"})
    assert wheel.is_compiled()


@pytest.mark.parametrize(
    ("target", "is_compiled"),
    [
        ((HOST[0], "x86-64-v3", SOME_FEATURES), False),
        ((HOST[0], "x86-64-v9", f"{SOME_FEATURES},+of-the-future"), True),
        (("of-another-system", *HOST[1:]), True),
    ],
)
def test_code_is_loaded_where_the_processor_has_all_features(
    tmp_path, monkeypatch, target, is_compiled
):
    wheel = Wheel(tmp_path, monkeypatch, target)
    assert wheel.is_compiled() == is_compiled
    shipped_code.shipped_for.cache_clear()


def test_a_processor_named_by_the_user_has_code_for_it_alone(tmp_path, monkeypatch):
    wheel = Wheel(tmp_path, monkeypatch, (HOST[0], "x86-64-v3", SOME_FEATURES))
    monkeypatch.setattr(shipped_code.numba.config, "CPU_NAME", HOST[1])
    assert wheel.is_compiled()
    shipped_code.shipped_for.cache_clear()


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [lambda whole: whole[:40], lambda whole: whole[:-1] + b"?"])
def test_damaged_code_is_compiled_and_a_line_says_so(wheel, ending, damage, caplog):
    (file,) = wheel.folder.glob(f"*.{ending}")
    file.write_bytes(damage(file.read_bytes()))
    with caplog.at_level(logging.DEBUG, "pymc_statespace_filters"):
        assert wheel.is_compiled()
    assert [record.getMessage() for record in caplog.records] == [
        f"{file} is not the file that was shipped"
    ]


def test_a_missing_file_is_compiled(wheel):
    for file in wheel.folder.glob("*.nb?"):
        file.unlink()
    assert wheel.is_compiled()


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"versions": 1', "\xff"])
def test_a_damaged_manifest_is_as_none(wheel, text):
    wheel.manifest.write_text(text, encoding="latin-1")
    assert wheel.is_compiled()


@pytest.mark.parametrize("entry", ["versions", "target", "checksums"])
@pytest.mark.parametrize("value", [None, [], [None] * 3])
def test_a_manifest_of_other_entries_is_as_none(wheel, entry, value):
    wheel.change(**{entry: value})
    assert wheel.is_compiled()


ROOT_OF_A_MATRIX = """
import runpy, sys
from ctypes import CFUNCTYPE, c_int64, c_void_p
from pathlib import Path
import numpy as np
from pytensor.link.numba import cache
from pymc_statespace_filters.compiler.lowering.constants import SQUARE_ROOT
from pymc_statespace_filters.compiler.native import shipped_code

script, shipped, task, level = sys.argv[1:]
shipped_code.FOLDER = Path(shipped)
SQUARE_ROOT.compile()
matrix = np.random.default_rng(1).standard_normal((9, 9))
matrix = matrix @ matrix.T
CFUNCTYPE(None, c_void_p, c_int64)(SQUARE_ROOT.address)(matrix.ctypes.data, 9)
if task == "build":
    runpy.run_path(script)["keep"](Path(shipped, level), "")
print(matrix.tobytes().hex(), *sorted(file.suffix for file in cache.NUMBA_CACHE_PATH.glob("*.nb?")))
"""


def test_code_of_a_wheel_gives_the_bits_of_compiled_code(tmp_path):
    """Compiled for its level, and loaded for this processor, whatever that is."""
    levels = MACHINE_CODE["levels_of_this_processor"]()
    if not levels:
        pytest.skip("no wheel has machine code for this system")
    level, inherited = levels[0], {k: v for k, v in os.environ.items() if "NUMBA" not in k}

    def run(task, variables):
        command = [sys.executable, "-c", ROOT_OF_A_MATRIX, PACKAGING / "machine_code.py"]
        return subprocess.run(
            [*command, tmp_path / "shipped", task, level],
            env=inherited | variables,
            capture_output=True,
            timeout=LIMIT,
            text=True,
            check=True,
        ).stdout.split()

    built = run("build", MACHINE_CODE["variables"](level, tmp_path / "own"))
    cache = {"PYTENSOR_FLAGS": f"base_compiledir={(tmp_path / 'empty').as_posix()},cxx="}
    loaded = run("load", cache)
    assert built[1:] == [".nbc", ".nbi"]
    assert loaded == built[:1]
