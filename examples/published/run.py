"""Compute what others published, and compare: the table of ``docs/reference/published.md``.

Run it with ``make published``. It fails if a number is more than three standard errors off. Names
of studies behind it select some of them.
"""

import sys
from importlib import import_module
from pathlib import Path

from comparison import LARGEST_Z, table

STUDIES = ("neurons", "lorenz_63", "kitagawa", "ricker", "blowflies")
TABLE = Path(__file__).parents[2] / "docs" / "_static" / "published.inc"


def main(names: list[str]) -> None:
    studies = [import_module(name).study() for name in names or STUDIES]
    found = table(studies)
    if not names:
        TABLE.write_text(found, encoding="utf-8")
    print(found)
    wrong = [
        f"{study.title}: {c.quantity} (z = {c.z:+.2f})"
        for study in studies
        for c in study.comparisons
        if not abs(c.z) <= LARGEST_Z
    ]
    if wrong:
        raise SystemExit("more than three standard errors off:\n" + "\n".join(wrong))


if __name__ == "__main__":
    main(sys.argv[1:])
