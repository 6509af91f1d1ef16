"""Compute what others published, and compare: the table of ``docs/reference/published.md``.

Run it with ``make published``. It fails if a number is more than three standard errors off, or if
the z of a study scatter less or more than its errors say. Names of studies behind it select some of
them.
"""

import sys
from importlib import import_module
from pathlib import Path

from comparison import LARGEST_Z, spreads, table

STUDIES = (
    "neurons",
    "lorenz_63",
    "kitagawa",
    "ricker",
    "blowflies",
    "measles",
    "lynx_hare",
    "armadillo",
    "kangaroos",
    "earthquakes",
    "growth",
)
TABLE = Path(__file__).parents[2] / "docs" / "_static" / "published.inc"


def main(names: list[str]) -> None:
    studies = [import_module(name).study() for name in names or STUDIES]
    found = table(studies)
    print(found)
    wrong = [
        f"{study.title}: {c.quantity} (z = {c.z:+.2f})"
        for study in studies
        for c in study.comparisons
        if not abs(c.z) <= LARGEST_Z
    ]
    wrong += [
        f"{s.what}: mean z² = {s.mean_square:.2g}, not in {s.low:.2f} to {s.high:.2f}"
        for s in spreads(studies)
        if not s.low <= s.mean_square <= s.high
    ]
    if wrong:
        raise SystemExit("not what others published, or the errors are wrong:\n" + "\n".join(wrong))
    if not names:
        TABLE.write_text(found, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
