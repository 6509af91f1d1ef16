"""Machine code on disk is found under a key that follows the sources it was made by."""

import pytest

from pymc_statespace_filters.compiler.native.cache_key import digest_of_sources

SOURCES = (
    "errors.py",
    "system/model.py",
    "compiler/native/jit.py",
    "filters/enkf.py",
    "filters/ensemble/deep/loop.py",
    "ops/base.py",
    "evaluation/simulate.py",
    "pymc_model/dispatch.py",
)


@pytest.fixture
def package(tmp_path):
    for path in (*SOURCES, "plots/states.py"):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"# {path}\n")
    return tmp_path


@pytest.mark.parametrize("path", SOURCES)
def test_a_changed_source_changes_the_key_in_nested_folders_too(package, path):
    before = digest_of_sources(package)
    (package / path).write_text("# changed\n")
    assert digest_of_sources(package) != before


def test_a_new_nested_source_changes_the_key(package):
    before = digest_of_sources(package)
    (package / "filters/ensemble/weights.py").write_text("")
    assert digest_of_sources(package) != before


def test_a_moved_source_changes_the_key(package):
    before = digest_of_sources(package)
    (package / "filters/enkf.py").rename(package / "filters/ensemble/enkf.py")
    assert digest_of_sources(package) != before


def test_a_source_that_no_machine_code_is_made_by_leaves_the_key(package):
    before = digest_of_sources(package)
    (package / "plots/states.py").write_text("# changed\n")
    assert digest_of_sources(package) == before
