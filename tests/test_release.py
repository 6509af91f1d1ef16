"""What a release says of itself in several places is the same in all of them."""

import re
import runpy
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import pymc_statespace_filters as psf
from tests.test_public_names import code_of

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
RECIPE = yaml.safe_load((ROOT / "packaging" / "recipe.yaml").read_text(encoding="utf-8"))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere():
    """That of the metadata is the guide's; the environment is made anew if the version changes."""
    assert version("pymc-statespace-filters") == psf.__version__
    assert yaml.safe_load(text_of("CITATION.cff"))["version"] == psf.__version__
    assert RECIPE["context"]["version"] == psf.__version__
    releases = re.findall(r"^## \[(\d.*?)\](.*)$", text_of("CHANGELOG.md"), flags=re.MULTILINE)
    for number, date in releases[:1]:
        assert number == psf.__version__
        assert re.fullmatch(r" - \d{4}-\d\d-\d\d", date)


def test_the_recipe_has_the_dependencies_of_the_package():
    python, *run = (line.replace(" ", "", 1) for line in RECIPE["requirements"]["run"])
    assert sorted(run) == sorted(PROJECT["project"]["dependencies"])
    assert python == "python>=${{ python_min }}"
    assert PROJECT["project"]["requires-python"] == f">={RECIPE['context']['python_min']}"
    host = [line.replace(" ", "", 1) for line in RECIPE["requirements"]["host"]]
    assert host[2:] == PROJECT["build-system"]["requires"]


def test_the_recipe_has_the_words_of_the_package():
    project = PROJECT["project"]
    assert RECIPE["context"]["name"] == project["name"]
    assert RECIPE["about"]["summary"] == project["description"]
    assert RECIPE["about"]["license"] == project["license"]
    assert [RECIPE["about"]["license_file"]] == project["license-files"]


def test_the_long_description_is_whole_without_the_repository():
    """PyPI has no picture of ours, and no page that a link without a host could lead to."""
    page = PROJECT["project"]["readme"]
    assert code_of(page) == code_of("README.md")
    targets = re.findall(r"\]\((.*?)\)|(?:src|href)=\"(.*?)\"", text_of(page))
    assert all("".join(target).startswith("https://") for target in targets)


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_run_what_exists(workflow):
    """On every system alike, so Python or a file alone; the schema is held by the release check."""
    jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands
    for command in commands:
        files = [word for word in command.split() if re.search(r"[./]", word) and word != "."]
        assert all((ROOT / file).is_file() for file in files)
        assert command.startswith("python ") or command == ".ci/run"


def test_workflows_have_every_python_that_is_promised():
    classified = {
        line.rpartition(" ")[2]
        for line in PROJECT["project"]["classifiers"]
        if re.search(r"Python :: 3\.", line)
    }
    (tests,) = (path for path in WORKFLOWS if path.stem == "tests")
    matrix = yaml.safe_load(tests.read_text(encoding="utf-8"))["jobs"]["suite"]["strategy"][
        "matrix"
    ]
    assert set(matrix["python"]) == classified


CHECK = runpy.run_path(str(ROOT / "packaging" / "release_check.py"))


def test_the_release_check_runs_tests_that_exist():
    assert [path for path in CHECK["TESTS"] if not (ROOT / path).exists()] == []


def test_a_wheel_that_has_grown_fails_the_release_check(tmp_path, capsys):
    """The quick part of the check, which builds both distributions, is a step of .ci/run."""
    assert "make release-quick" in text_of(".ci/run")
    wheel = tmp_path / "pymc_statespace_filters-0.1.0-py3-none-any.whl"
    wheel.write_bytes(bytes(CHECK["MAX_WHEEL_BYTES"]))
    with pytest.raises(SystemExit, match=f"{wheel.name} has 1450000 bytes, not below 1450000"):
        CHECK["check_wheel"](wheel)
