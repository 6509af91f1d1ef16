"""The code that the README shows runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.filterwarnings("ignore:.*:pymc_statespace_filters.SamplingWarning")
def test_twenty_lines(capsys: pytest.CaptureFixture) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert np.isfinite(names["evidence"].log_evidence)
    assert dict(names["idata"]["posterior"].sizes) == {"chain": 2, "draw": 500}
    assert capsys.readouterr().out.split()[1] == "+-"
