"""The code that the README shows runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).parent.parent / "README.md"


def test_twenty_lines(capsys: pytest.CaptureFixture) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert np.isfinite(names["evidence"].log_evidence)
    assert dict(names["idata"]["posterior"].sizes) == {"chain": 2, "draw": 2000}
    last_line = capsys.readouterr().out.splitlines()[-1]
    assert last_line.split()[1] == "+-"
