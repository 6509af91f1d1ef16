"""Build the distributions, and test them where nothing of the checkout can be imported.

Run by `make release-check`, with a network on which pip finds its packages. Needs git and nothing
else beside Python; works on Linux, macOS and Windows. Leaves the wheel, the sdist and the recipe of
conda-forge in dist/, and on Linux and x86-64 a second wheel, with machine code for this Python.
With `--quick`, as `make release-quick` and continuous integration run it, the contents and metadata
alone are checked, in seconds and by the environment that runs it.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
PACKAGE = "pymc_statespace_filters"
# 1.38 MB when this was set, and 5 %: who adds more makes the package smaller elsewhere, or says
# here what is worth the bytes that every user loads. The last 0.1 MB: events and clinical tables,
# censored data, designs of experiments, identifiability, and fields of unknown form.
MAX_WHEEL_BYTES = 1_450_000
MAX_BYTES_WITH_CODE = 15_000_000  # 8.2 MB when this was set
CODE = f"{PACKAGE}/_machine_code/"

# The parts of the suite that the installed package is held to: each layer once, and all that
# depends on the operating system.
TESTS = (
    "tests/parallel",
    "tests/compiler/native",
    "tests/system/test_model.py",
    "tests/filters/test_truth_ekf.py",
    "tests/filters/test_bootstrap_page.py",
    "tests/evaluation/test_log_likelihood.py",
    "tests/evidence/test_bridge.py",
    "tests/sampling/test_checkpoint_file.py",
    "tests/sampling/test_checkpoint_folder.py",
    "tests/sampling/test_interrupts.py",
    "tests/sampling/test_run_models.py",
)
RENDER = """
import sys
from rattler_build import Stage0Recipe
for variant in Stage0Recipe.from_file(sys.argv[1]).render():
    recipe = variant.recipe
    print(recipe.package.name, recipe.package.version)
"""

# Variables that begin so could lead to the checkout, or change what is compiled.
_LEADING = ("PYTHON", "PYTENSOR", "NUMBA")


class Environment:
    """A virtual environment; what runs in it sees no variable that could lead to the checkout."""

    def __init__(self, folder: Path, **variables: str):
        venv.create(folder, with_pip=True)
        self.folder = folder
        self._scripts = folder / ("Scripts" if os.name == "nt" else "bin")
        kept = {k: v for k, v in os.environ.items() if not k.startswith(_LEADING)}
        path = os.pathsep.join([str(self._scripts), os.environ.get("PATH", "")])
        self._variables = kept | {"PATH": path} | variables

    def run(self, *command: str | Path, cwd: Path | None = None, **variables: str) -> None:
        """Run a command of the environment, as ``python -m pip``."""
        program = shutil.which(str(command[0]), path=str(self._scripts))
        if program is None:
            sys.exit(f"there is no {command[0]} in {self._scripts}")
        done = subprocess.run(
            [program, *map(str, command[1:])],
            cwd=cwd or self.folder,
            env=self._variables | variables,
            check=False,
        )
        if done.returncode:
            sys.exit(f"release-check: {' '.join(map(str, command))} has failed")

    def install(self, *what: str | Path) -> None:
        """Install by pip, with all that it needs."""
        self.run("python", "-m", "pip", "install", "-q", "--disable-pip-version-check", *what)


@contextmanager
def step(name: str) -> Iterator[None]:
    """Say what is done, and how long it took."""
    print(f"=== {name}", flush=True)
    begin = perf_counter()
    yield
    print(f"=== {name}: good, {perf_counter() - begin:.0f} s", flush=True)


def require(condition: bool, message: str) -> None:
    """End with this message unless the condition holds."""
    if not condition:
        sys.exit(f"release-check: {message}")


def built(folder: Path) -> tuple[Path, Path]:
    """The wheel and the sdist in a folder."""
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def tracked_files() -> set[str]:
    """What git tracks."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, encoding="utf-8"
    )
    return set(listed.stdout.split("\0")) - {""}


def check_wheel(wheel: Path, limit: int = MAX_WHEEL_BYTES) -> None:
    """The package, its metadata and its licence; nothing else, and not much of it."""
    size = wheel.stat().st_size
    print(f"{wheel.name}: {size} bytes")
    require(size < limit, f"{wheel.name} has {size} bytes, not below {limit}")
    info = "-".join(wheel.name.split("-")[:2]) + ".dist-info/"
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.startswith(CODE)}
    sources = {name for name in tracked_files() if name.startswith(f"{PACKAGE}/")}
    metadata = {info + name for name in ("METADATA", "WHEEL", "RECORD", "licenses/LICENSE")}
    compare(wheel, names, sources | metadata)


def check_sdist(sdist: Path) -> None:
    """All that git tracks, and so all that the tests and the guide need; nothing else."""
    print(f"{sdist.name}: {sdist.stat().st_size} bytes")
    top = sdist.name.removesuffix(".tar.gz") + "/"
    with tarfile.open(sdist) as archive:
        names = {member.name.removeprefix(top) for member in archive if member.isfile()}
    compare(sdist, names, tracked_files() | {"PKG-INFO"})


def compare(archive: Path, names: set[str], wanted: set[str]) -> None:
    """Name the files that are missing, and those that should not be there."""
    missing, more = sorted(wanted - names), sorted(names - wanted)
    require(not missing, f"{archive.name} lacks {', '.join(missing)}")
    require(not more, f"{archive.name} holds {', '.join(more)}, which git does not track")


def write_recipe(sdist: Path) -> Path:
    """The recipe of conda-forge with the checksum of the sdist, and the script of its test."""
    checksum = hashlib.sha256(sdist.read_bytes()).hexdigest()
    recipe = (ROOT / "packaging" / "recipe.yaml").read_text(encoding="utf-8")
    head, url, tail = recipe.partition(".tar.gz\n")
    target = DIST / "recipe" / "recipe.yaml"
    target.parent.mkdir()
    target.write_text(f"{head}{url}  sha256: {checksum}\n{tail}", encoding="utf-8", newline="\n")
    shutil.copy(ROOT / "packaging" / "smoke.py", target.parent)
    return target


def check_files(tools: Environment, recipe: Path) -> None:
    """The recipe is rendered; workflows and citation are held to their schemas."""
    tools.run("python", "-c", RENDER, recipe)
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    check = ("check-jsonschema", "--builtin-schema")
    tools.run(*check, "vendor.github-workflows", *workflows)
    tools.run(*check, "vendor.citation-file-format", ROOT / "CITATION.cff")


def check_origin(environment: Environment) -> None:
    """The package that is imported is the installed one."""
    code = f"import sys, {PACKAGE} as p; sys.exit(not p.__file__.startswith(sys.prefix))"
    environment.run("python", "-c", code)


def unpacked(sdist: Path, folder: Path) -> Path:
    """The sdist without the package, which could be imported in place of the installed one."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (top,) = folder.iterdir()
    shutil.rmtree(top / PACKAGE)
    return top


def with_machine_code(wheel: Path, code: Path, user: Environment, tools: Environment) -> Path:
    """The wheel with a folder of machine code, for the Python and the systems of numba's wheel."""
    tools.run("wheel", "unpack", wheel, "-d", code.parent / "tree")
    (tree,) = (code.parent / "tree").iterdir()
    shutil.copytree(code, tree / CODE)
    (of_numba,) = user.folder.rglob("numba-*.dist-info/WHEEL")
    lines = of_numba.read_text(encoding="utf-8").splitlines()
    tags = "\n".join(line for line in lines if line.startswith("Tag: "))
    (own,) = tree.glob("*.dist-info/WHEEL")
    text = own.read_text(encoding="utf-8").replace("Tag: py3-none-any", tags)
    text = text.replace("Root-Is-Purelib: true", "Root-Is-Purelib: false")
    own.write_text(text, encoding="utf-8")
    before = set(DIST.iterdir())
    tools.run("wheel", "pack", tree, "-d", DIST)
    (packed,) = set(DIST.iterdir()) - before
    return packed


def run_readme(environment: Environment, cache: Path) -> None:
    """Run the example of the README on an empty cache, and say what it took."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    example = readme.partition("```python\n")[2].partition("```")[0]
    took = "import time\nprint(f'README, empty cache: {time.process_time():.1f} CPU s')\n"
    program = cache.with_suffix(".py")
    program.write_text(example + took, encoding="utf-8")
    flags = f"base_compiledir={cache.as_posix()},cxx="
    environment.run("python", program, PYTENSOR_FLAGS=flags)


def check_machine_code(wheel: Path, user: Environment, tools: Environment, work: Path) -> None:
    """Build the wheel with machine code, if this system has one, and install it elsewhere.

    Its code gives the numbers of own compilation, and nothing of the README is compiled by numba.
    """
    code, script = work / "machine_code", work / "machine_code.py"
    shutil.copy(ROOT / "packaging" / script.name, work)
    user.run("python", script, "build", code)
    if not code.exists():
        print("there is no machine code for this system")
        return
    packed = with_machine_code(wheel, code, user, tools)
    tools.run("twine", "check", "--strict", packed)
    check_wheel(packed, MAX_BYTES_WITH_CODE)
    other = Environment(work / "other", MPLBACKEND="agg")
    other.install(packed)
    check_origin(other)
    other.run("python", script, "check")
    for environment in (user, other):
        run_readme(environment, environment.folder.with_suffix(".cache"))
    compiled = [file.name for file in (work / "other.cache").rglob("*.nbi")]
    require(not compiled, f"{packed.name} has no code of {', '.join(compiled)}")


def check_metadata(wheel: Path) -> None:
    """The metadata are valid, and say which Python, licence and description they are of."""
    from packaging.metadata import Metadata

    (name,) = (n for n in zipfile.ZipFile(wheel).namelist() if n.endswith(".dist-info/METADATA"))
    found = Metadata.from_email(zipfile.ZipFile(wheel).read(name), validate=True)
    page = (ROOT / "packaging" / "pypi.md").read_text(encoding="utf-8")
    require(found.description == page, f"the description of {wheel.name} is not packaging/pypi.md")
    for field in ("requires_python", "license_expression", "requires_dist"):
        require(bool(getattr(found, field)), f"{wheel.name} has no {field}")


def quick() -> None:
    """Build in the environment that runs this, and check contents and metadata."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name, step("contents"):
        command = [sys.executable, "-m", "hatchling", "build", "-d", name]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        wheel, sdist = built(Path(name))
        check_wheel(wheel)
        check_sdist(sdist)
        check_metadata(wheel)


def main() -> None:
    """Run all steps; the first that fails ends the run."""
    begin = perf_counter()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        work = Path(name).resolve()
        with step("build"):
            shutil.rmtree(DIST, ignore_errors=True)
            tools = Environment(work / "tools")
            tools.install("-r", ROOT / "packaging" / "requirements.txt")
            tools.run("python", "-m", "build", "--outdir", DIST, ROOT)
            wheel, sdist = built(DIST)
        with step("contents"):
            tools.run("twine", "check", "--strict", wheel, sdist)
            check_wheel(wheel)
            check_sdist(sdist)
            check_files(tools, write_recipe(sdist))
        with step("install the wheel"):
            user = Environment(
                work / "user",
                PYTENSOR_FLAGS=f"base_compiledir={(work / 'code').as_posix()}",
                MPLBACKEND="agg",
            )
            user.install(wheel)
            user.run("python", "-m", "pip", "check")
            check_origin(user)
        with step("first run"):
            shutil.copy(ROOT / "packaging" / "smoke.py", work)
            user.run("python", "-W", "error", work / "smoke.py")
        with step("machine code"):
            check_machine_code(wheel, user, tools, work)
        with step("doctests of the wheel"):
            user.install(f"{wheel}[test]")
            tests = unpacked(sdist, work / "unpacked")
            pytest = ["python", "-m", "pytest", "-q", "-n", "2", "-p", "no:cacheprovider"]
            settings = ["-c", tests / "pyproject.toml", "-o", "pythonpath="]
            user.run(*pytest, *settings, "--pyargs", PACKAGE)
        with step("tests of the sdist"):
            user.install("--force-reinstall", "--no-deps", sdist)
            check_origin(user)
            user.run(*pytest, "--dist", "loadfile", *TESTS, cwd=tests)
    print(f"release-check: all good, {perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    quick() if sys.argv[1:] == ["--quick"] else main()
