"""The code that the README and the guide show runs as it stands."""

import re
from pathlib import Path

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pytest

# PyMC writes progress to the stderr of its import: imported in a test, to one that is closed later.
import pymc_statespace_filters  # noqa: F401

ROOT = Path(__file__).parent.parent


def run_code_of(*pages: str) -> dict:
    """Run the code of pages in their order, a later one with the names of those before."""
    names: dict = {}
    for page in pages:
        blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)
        exec(compile("\n".join(blocks), page, "exec"), names)
    return names


def test_twenty_lines(capsys: pytest.CaptureFixture) -> None:
    names = run_code_of("README.md")
    assert np.isfinite(names["evidence"].log_evidence)
    assert dict(names["idata"]["posterior"].sizes) == {"chain": 4, "draw": 2000}
    last_line = capsys.readouterr().out.splitlines()[-1]
    assert last_line.split()[1] == "+-"


def test_your_own_system() -> None:
    names = run_code_of("docs/tutorials/your_system.md")
    # The record was made by a hardening spring, and says so.
    assert names["table"].loc["hardening", "prob_low"] > 0.99
    assert np.isfinite(names["terms"]).all()


def test_evidence() -> None:
    with az.rc_context({"plot.backend": "matplotlib"}):
        names = run_code_of("docs/explanation/evidence.md")
    plt.close("all")
    table, found = names["table"], names["found"]
    assert found.agreement
    assert max(one.se for one in found.values()) < 0.1  # an agreement that says something
    # A cubic spring made the record, which shows that it is not linear, and no friction.
    assert list(table.index) == ["cubic", "friction", "linear"]
    assert table.loc["cubic", "prob_low"] > 0.6
    assert table.loc["linear", "prob_high"] < 0.01
    # At a width of one the prior is what it was, and so are the probabilities.
    as_it_is = names["curves"]["width_prob"].sel(width=1.0, model=list(table.index))
    np.testing.assert_allclose(as_it_is, table["prob"], rtol=1e-9)
    assert (names["curves"]["width_prob"].sel(model="cubic") > 0.5).all()
    assert names["curves"]["prob"].sel(exponent=4.0).idxmax("model") == "linear"  # as the page says
    force = names["average"]["posterior"]["restoring_force"].sel(place=2.0)
    assert abs(force.mean() - (2.0 + 0.2 * 2.0**3)) < 2 * force.std()
