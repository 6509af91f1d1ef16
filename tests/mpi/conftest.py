"""Tests by real ranks: all of this folder, by ``make test-mpi``, and none of them is skipped."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if HERE in item.path.parents:
            item.add_marker("mpi")


def unskipped(report):
    if report.skipped:
        report.outcome, report.longrepr = "failed", "tests of MPI may not skip"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    return unskipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return unskipped((yield))
