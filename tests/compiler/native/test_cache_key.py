"""Machine code on disk is found under a key that follows the sources it was made by."""

import shutil
from importlib.util import find_spec, module_from_spec
from pathlib import Path

import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.functions import member_function, vector_function
from pymc_statespace_filters.compiler.native import cache_key
from pymc_statespace_filters.compiler.native.cache_key import Sources, key_of
from pymc_statespace_filters.compiler.native.shipped_code import FOLDER

NAME = psf.__name__
LOOP, CODE = f"{NAME}.filters.ensemble.loop", f"{NAME}.compiler.codegen.functions"


class Copy:
    """A copy of the package; its ``keys`` are those of machine code that a new process makes."""

    def __init__(self, folder, kept, monkeypatch):
        self.root, self._kept, self._monkeypatch = folder / NAME, kept, monkeypatch
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(Path(psf.__file__).parent, self.root, ignore=unwanted)

    def edit(self, path, old, new):
        text = (self.root / path).read_text(encoding="utf-8")
        assert old in text
        (self.root / path).write_text(text.replace(old, new, 1), encoding="utf-8")

    def append(self, path, text):
        with (self.root / path).open("a", encoding="utf-8") as file:
            file.write(text)

    def start(self):
        """The sources as another process reads them."""
        read = Sources(self.root, self._kept)
        self._monkeypatch.setattr(cache_key, "_SOURCES", read)
        return read

    def symbol(self, module, name):
        """The symbol of the entry point of a filter, whose module is imported anew."""
        self.start()
        spec = find_spec(f"{NAME}.filters.{module}")
        fresh = module_from_spec(spec)
        spec.loader.exec_module(fresh)
        return getattr(fresh, name).entry.symbol

    def generated(self):
        """The key of a function that the code generator writes."""
        self.start()
        theta = pt.tensor("theta", shape=(2,), dtype="float64")
        graph = Graph({"theta": theta}, [2.0 * theta])
        return vector_function("f", "c", graph).key

    def module(self):
        """The key of a module, into which an exponential is linked."""
        self.start()
        x = pt.tensor("x", shape=(2,), dtype="float64")
        return member_function("f", "X", Graph({"x": x}, [pt.exp(x)]), "X").key


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Where processes keep what they found in the sources."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture
def copy(tmp_path, kept, monkeypatch):
    return Copy(tmp_path, kept, monkeypatch)


def test_a_filter_is_compiled_anew_only_if_it_reaches_what_changed(copy):
    bootstrap = copy.symbol("bootstrap", "BootstrapPF")
    assert bootstrap == psf.BootstrapPF.entry.symbol  # also from another folder
    copy.append("filters/point_mass/grid.py", "\nNUMBER = 1\n")
    assert copy.symbol("bootstrap", "BootstrapPF") == bootstrap
    copy.append("filters/ensemble/weights.py", "\nNUMBER = 1\n")
    assert copy.symbol("bootstrap", "BootstrapPF") != bootstrap


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [
        ("filters/ensemble/weights.py", '"""', '"""Another docstring. '),
        ("filters/ensemble/weights.py", "\nimport ", "\n# A comment.\n\n\nimport "),
        ("filters/ensemble/loop.py", '    """The outcome of an update', '    """It'),
        ("filters/ensemble/loop.py", "    return Outcome(-np.inf,", "    return Outcome( -np.inf,"),
    ],
)
def test_docstrings_comments_and_layout_change_no_key(copy, path, old, new):
    before = copy.symbol("bootstrap", "BootstrapPF")
    copy.edit(path, old, new)
    assert copy.symbol("bootstrap", "BootstrapPF") == before


@pytest.mark.parametrize(
    "path",
    [
        "compiler/codegen/emitter.py",
        "compiler/codegen/machine_code.py",
        "compiler/numerics/exponential.py",
        "compiler/native/jit.py",
    ],
)
def test_generated_code_follows_its_generator(copy, path):
    before = copy.generated()
    copy.append(path, "\nNUMBER = 1\n")
    assert copy.generated() != before


@pytest.mark.parametrize(
    "path", ["compiler/codegen/machine_code.py", "compiler/numerics/exponential.py"]
)
def test_a_module_follows_how_it_is_compiled_and_what_is_linked_into_it(copy, path):
    before = copy.module()
    copy.append(path, "\nNUMBER = 1\n")
    assert copy.module() != before


def test_generated_code_does_not_follow_filters(copy):
    before = copy.generated(), copy.module()
    copy.append("filters/ensemble/weights.py", "\nNUMBER = 1\n")
    assert (copy.generated(), copy.module()) == before


@pytest.mark.parametrize(
    "statement",
    [
        f"import {NAME}.filters.point_mass.grid",
        f"from {NAME}.filters.point_mass import grid",
        f"from {NAME}.filters.point_mass.grid import anything",
        "from ..point_mass.grid import anything",
        "from ..point_mass import grid as other",
        "def function():\n    from ..point_mass import grid",
    ],
)
def test_a_new_import_widens_what_is_covered(copy, statement):
    copy.append("filters/ensemble/weights.py", f"\n{statement}\n")
    before = copy.start().digest_of(LOOP)
    covered = copy.start().digest_of(f"{NAME}.filters.bootstrap")
    copy.append("filters/point_mass/grid.py", "\nNUMBER = 1\n")
    assert copy.start().digest_of(f"{NAME}.filters.bootstrap") != covered
    assert copy.start().digest_of(LOOP) == before  # which does not import the weights


def test_names_that_a_package_defines_are_in_its_init(copy):
    (copy.root / "filters/ensemble/__init__.py").write_text("NUMBER = 1\n")
    before = copy.start().digest_of(LOOP)
    (copy.root / "filters/ensemble/__init__.py").write_text("NUMBER = 2\n")
    assert copy.start().digest_of(LOOP) == before
    copy.append("filters/ensemble/loop.py", "\nfrom . import NUMBER\n")
    before = copy.start().digest_of(LOOP)
    (copy.root / "filters/ensemble/__init__.py").write_text("NUMBER = 3\n")
    assert copy.start().digest_of(LOOP) != before


def test_a_moved_module_changes_the_key(copy):
    before = copy.start().digest_of(CODE)
    (copy.root / "compiler/codegen/functions.py").rename(copy.root / "compiler/codegen/moved.py")
    assert copy.start().digest_of(f"{NAME}.compiler.codegen.moved") != before


def test_a_change_after_the_sources_were_read_is_of_another_process(copy):
    """An upgrade while the process runs: its functions are those of the version before."""
    read = copy.start()
    assert LOOP in read
    copy.append("filters/ensemble/weights.py", "\nNUMBER = 1\n")
    assert read.digest_of(CODE) == copy.start().digest_of(CODE)
    bootstrap = f"{NAME}.filters.bootstrap"
    assert read.digest_of(bootstrap) != copy.start().digest_of(bootstrap)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"a": 1}', '{"a": ["b"]}', "\ufffe"])
def test_what_was_kept_of_the_sources_may_be_damaged(copy, kept, content):
    module = f"{NAME}.compiler.native.jit"
    expected = copy.start().digest_of(module)
    (file,) = kept.iterdir()
    whole = file.read_bytes()
    file.write_text(content, encoding="utf-8")
    assert copy.start().digest_of(module) == expected
    assert file.read_text(encoding="utf-8") != content
    file.write_bytes(whole)


def test_keys_tell_versions_of_the_compilers_apart(monkeypatch):
    before = key_of(LOOP, "text")
    monkeypatch.setattr(cache_key, "_COMPILERS", ("0",))
    assert key_of(LOOP, "text") != before


def test_code_outside_the_package_has_no_key_by_its_module():
    assert key_of(__name__, "text") is None
    assert key_of(f"{NAME}.no_module", "text") is None
    assert key_of(LOOP, "text", None) is None


def test_sources_are_parsed_once_for_all_processes(copy, monkeypatch):
    expected = copy.start().digest_of(LOOP)
    monkeypatch.setattr(cache_key.ast, "parse", None)
    assert copy.start().digest_of(LOOP) == expected


def test_a_wheel_with_machine_code_has_the_sources_parsed(copy, kept, monkeypatch, tmp_path):
    expected = copy.start().digest_of(LOOP)
    shutil.copytree(kept, copy.root / FOLDER.name)
    monkeypatch.setattr(cache_key.ast, "parse", None)
    assert Sources(copy.root, tmp_path / "empty").digest_of(LOOP) == expected


def test_what_another_version_of_the_parser_kept_is_not_read(copy, monkeypatch, tmp_path):
    copy.start().digest_of(LOOP)
    other = tmp_path / "cache_key.py"
    other.write_text("another text", encoding="utf-8")
    monkeypatch.setattr(cache_key, "_THIS", other)
    monkeypatch.setattr(cache_key.ast, "parse", None)
    with pytest.raises(TypeError, match="not callable"):
        copy.start().digest_of(LOOP)
