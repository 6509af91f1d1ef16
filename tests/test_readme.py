"""The code that the README and the guide show runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

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
    names = run_code_of("docs/your_system.md")
    # The record was made by a hardening spring, and says so.
    assert names["table"].loc["hardening", "prob_low"] > 0.99
    assert np.isfinite(names["terms"]).all()
