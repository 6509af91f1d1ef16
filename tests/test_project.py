"""What the project promises about itself rather than about numbers."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from numba.core.registry import cpu_target
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import pymc_statespace_filters as psf
from tests.costs import resident_mb
from tests.waiting import LIMIT

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

LOCK_OF = {"sys_platform": "linux"}


def locked_versions():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(pin.name): str(pin.specifier) for pin in pins}


def test_lock_holds_exact_versions():
    assert all(specifier.startswith("==") for specifier in locked_versions().values())


def test_lock_holds_every_dependency_within_its_bounds():
    extras = PROJECT["optional-dependencies"].values()
    lines = PROJECT["dependencies"] + [line for extra in extras for line in extra]
    wanted = [Requirement(line) for line in lines if not line.startswith(PROJECT["name"])]
    locked = locked_versions()
    for requirement in wanted:
        if requirement.marker is not None and not requirement.marker.evaluate(LOCK_OF):
            continue  # of another system than the lock's
        version = locked[canonicalize_name(requirement.name)].removeprefix("==")
        assert version in requirement.specifier, f"{requirement}, locked at {version}"


@cache
def nodes_of(file):
    """Every node of the syntax tree of a file."""
    return list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def imports_from_elsewhere():
    """Every module that the package imports from elsewhere, and the file that does."""
    for file in (ROOT / "pymc_statespace_filters").rglob("*.py"):
        for node in nodes_of(file):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module]
            else:
                continue
            for module in modules:
                if module.partition(".")[0] not in {*sys.stdlib_module_names, psf.__name__}:
                    yield module, file.relative_to(ROOT / psf.__name__).as_posix()


def test_imported_distributions_are_the_declared_dependencies():
    optional = [line for line in PROJECT["optional-dependencies"]["jax"] if line.startswith("jax")]
    lines = [*PROJECT["dependencies"], *optional]
    declared = {canonicalize_name(Requirement(line).name) for line in lines}
    imported = {
        canonicalize_name(module.partition(".")[0]) for module, _ in imports_from_elsewhere()
    }
    # PyMC imports matplotlib without depending on it; users import arviz, which is its three parts.
    assert imported | {"matplotlib", "arviz"} == declared


# import-linter sees only whole external packages.
INSIDES = ("llvmlite", "numba.core", "numba.extending", "pytensor.link")
TOUCH_INSIDES = {
    # how operations and the random variable become machine code
    "ops/base.py": "pytensor.link",
    "ops/jax.py": "pytensor.link",
    "pymc_model/dispatch.py": "pytensor.link",
    # the name of the processor that numba compiles for
    "parallel/environment.py": "numba.core",
    # vector instructions that numba does not have
    "filters/kernel_density/simd_windows.py": ("llvmlite", "numba.core", "numba.extending"),
    "filters/point_mass/tiles.py": ("llvmlite", "numba.core", "numba.extending"),
    # functions that run in Python too
    "sampling/kernel/adaptation_state.py": "numba.extending",
    "sampling/kernel/independence.py": "numba.extending",
}


def test_the_insides_of_numba_and_pytensor_are_met_in_the_compiler_alone():
    outside = {
        (module, file)
        for module, file in imports_from_elsewhere()
        if module.startswith(INSIDES)
        and not file.startswith("compiler/")
        and not module.startswith(TOUCH_INSIDES.get(file, ("nothing",)))
    }
    assert outside == set()


def test_no_end_of_chains_imports_jax():
    """As these functions of SciPy do, where JAX is installed and ArviZ imported."""
    found = {
        f"{room}: {node.module}.{alias.name}"
        for room in ("sampling", "checks", "smc", "statistics")
        for file in (ROOT / psf.__name__ / room).rglob("*.py")
        for node in nodes_of(file)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name in {"logsumexp", "softmax", "log_softmax"}
    }
    assert found == set()


def opened_without_encoding(file):
    """The lines of a file that read or write text in the encoding of the system."""
    for node in nodes_of(file):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            is_open = name.endswith("open") and name not in {"os.open", "tarfile.open"}
            is_text = name.endswith(("read_text", "write_text"))
            if not is_open and not is_text:
                continue
            call = ast.unparse(node)
            if is_open and not re.search(r"'[rwax]\+?b'", call):
                is_text = True
            if is_text and "encoding=" not in call:
                yield f"{file.relative_to(ROOT).as_posix()}:{node.lineno}"


def test_text_is_utf8_on_every_system():
    """Without an encoding, Windows reads UTF-8 as something else, or not at all."""
    folders = ("pymc_statespace_filters", "docs", "examples", "packaging")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    assert [line for file in files for line in opened_without_encoding(file)] == []
    # lazy_loader reads the stub in the encoding of the system.
    assert (ROOT / psf.__name__ / "__init__.pyi").read_bytes().isascii()


def test_importing_a_sampler_is_silent_and_leaves_mpi_jax_and_statistics_alone():
    script = (
        "import sys; from pymc_statespace_filters import sample_dram, sample_smc; "
        "sys.exit(bool({'mpi4py', 'jax', 'arviz_stats'} & set(sys.modules)))"
    )
    command = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.fixture
def make(tmp_path):
    """Dry-run `make test` where only the given interpreters fit, out of python3 and python3.13."""
    program = shutil.which("make")
    if program is None:
        pytest.skip("make is not installed")

    def run(*fitting):
        for name in ("python3", "python3.13"):
            script = f'exec "{sys.executable}" "$@"' if name in fitting else "exit 1"
            (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
            (tmp_path / name).chmod(0o755)
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
        return subprocess.run(
            [program, f"VENV={tmp_path}/venv", f"{tmp_path}/venv/.installed"],
            cwd=ROOT,
            env=environment | {"PATH": str(tmp_path), "MAKEFLAGS": "n" if fitting else ""},
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )

    return run


def test_make_takes_python3_if_it_fits(make):
    assert "\npython3 -m venv" in "\n" + make("python3", "python3.13").stdout


def test_make_takes_another_python_if_python3_does_not_fit(make):
    assert "\npython3.13 -m venv" in "\n" + make("python3.13").stdout


def test_make_says_what_is_missing_if_no_python_fits(make):
    done = make()
    assert done.returncode != 0
    assert "Python 3.12, 3.13 or 3.14" in done.stdout
    assert "venv" in done.stdout


def run_as_make_does(tests):
    """Run the tests of a folder by the options of the Makefile."""
    (options,) = re.findall(r"^PYTEST = (.*)$", (ROOT / "Makefile").read_text("utf-8"), re.M)
    settings = ("-p", "tests.conftest", "-c", ROOT / "pyproject.toml")
    return subprocess.run(
        [sys.executable, *options.split(), *settings, tests],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )


DYING = """
import os, time
import pytest

@pytest.mark.parametrize("i", range(3))
def test_one(i):
    time.sleep(0.1)
    if {dies} and i == 1:
        os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_worker_that_dies_ends_the_run(tmp_path):
    """By the options of the Makefile: pytest-xdist would wait for ever for another in its place."""
    for number in range(4):
        file = tmp_path / f"test_{number}.py"
        file.write_text(DYING.format(dies=number == 1), encoding="utf-8")
    done = run_as_make_does(tmp_path)
    assert done.returncode == 1, done.stderr
    assert "crashed while running" in done.stdout
    assert "worker restarting disabled" in done.stdout


def test_a_run_that_compiles_more_than_is_known_fails(tmp_path):
    """That it passes otherwise, every run of all tests shows."""
    for name in ("one", "other"):
        lines = "from numba import njit", f"def test_{name}():", "    njit(lambda x: x + 1)(1)"
        (tmp_path / f"test_{name}.py").write_text("\n".join(lines), encoding="utf-8")
    known = "import tests.costs\ntests.costs.MOST = 1"
    (tmp_path / "conftest.py").write_text(known, encoding="utf-8")
    done = run_as_make_does(tmp_path)
    assert done.returncode == 1, done.stdout
    assert "2 functions were compiled" in done.stdout, done.stdout


@pytest.mark.skipif(
    resident_mb() is None, reason="the system does not tell how much memory is used"
)
def test_compilation_gives_the_memory_of_pass_managers_back():
    codegen = cpu_target.target_context.codegen()
    codegen._module_pass_manager()
    before = resident_mb()
    for _ in range(300):
        codegen._module_pass_manager()
    assert resident_mb() - before < 4  # of 9


def rooms():
    """Folders and files at the top of the package, as documents write them."""
    package = ROOT / "pymc_statespace_filters"
    folders = {f"{file.parent.name}/" for file in package.glob("*/__init__.py")}
    return folders | {file.name for file in package.glob("*.py")} - {"__init__.py"}


def test_contributing_names_every_room_once():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.partition("| package | contents |")[2].partition("\n\n")[0]
    named = re.findall(r"`([\w/.]+)`", "".join(row.split("|")[1] for row in table.split("\n")[2:]))
    assert sorted(named) == sorted(rooms())


def test_the_picture_of_the_design_is_that_of_the_contracts():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    (contract,) = [c for c in tools["importlinter"]["contracts"] if c["id"] == "layers"]
    layers = [[name.strip() for name in line.split("|")] for line in contract["layers"]]
    text = (ROOT / "docs/explanation/design.md").read_text(encoding="utf-8")
    picture = text.partition("```text\n")[2].partition("```")[0].splitlines()
    assert len(picture) == len(layers)
    for line, names in zip(picture[:-1], layers[:-1], strict=True):
        assert re.split(r"\s{2,}", line.strip())[: len(names)] == names
