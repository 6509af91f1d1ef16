"""Write the measurements to the tables of ``docs/reference/mpi_scaling.md``."""

import json
from pathlib import Path
from statistics import median

from benchmarks.mpi.cases import BOOTSTRAP, ENKF, EXACT, FAST, RANKS, SIZES
from benchmarks.mpi.likelihoods import Wall
from benchmarks.mpi.model import Link, Spread, links
from benchmarks.mpi.study_report import efficiency_table, gathering_table, study_table
from benchmarks.report import TARGET, number, seconds, table

THESIS = {1: 12.49, 2: 6.36, 4: 3.35, 8: 1.82, 10: 1.57, 20: 1.09, 40: 0.77, 100: 1.08}


def write(folder: Path) -> str:
    """Write the tables of all stored parts; return them."""
    kept = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    both = [kept.get(f"{part}_{k}", []) for part in PARTS for k in ("fast", "exact")]
    walls = {wall.case.name: wall for rows in both[:2] for wall in map(Wall.of_json, rows)}
    spreads = {s.case.name: s for rows in both[2:] for s in map(Spread.of_json, rows)}
    sections = [kept["machine"]["text"]]
    if "exchange" in kept:
        joined = links(kept["exchange"])
        sections += [
            "## One likelihood\n",
            likelihood_table((EXACT, FAST), walls, spreads, joined[1], with_thesis=True),
            likelihood_table((BOOTSTRAP, ENKF), walls, spreads, joined[1], with_thesis=False),
            "### Where it ends\n",
            ends_table(spreads, joined),
            "### What the model is made of\n",
            link_table(joined),
            make_table(spreads, walls, joined[0]),
        ]
    if "study" in kept:
        sections += [study_table(kept["study"]), efficiency_table(kept["study"])]
    if "gathering_2" in kept:
        sections.append(gathering_table(kept["gathering_1"], kept["gathering_2"]))
    text = "\n".join(sections)
    (TARGET / "mpi_scaling.inc").write_text(text)
    return text


PARTS = ("likelihoods", "threads")


def likelihood_table(
    kinds: tuple[str, ...],
    walls: dict[str, Wall],
    spreads: dict[str, Spread],
    link: Link,
    *,
    with_thesis: bool,
) -> str:
    """Return the table of run times: measured numbers upright, modelled ones in italics."""
    columns = [f"{kind}, {n}" for kind in kinds for n in SIZES]
    lines = []
    for n_ranks in RANKS:
        line = [str(n_ranks)]
        if with_thesis:
            line.append(f"{THESIS[n_ranks]:.2f} s" if n_ranks in THESIS else "")
        lines.append(line + [cell(name, n_ranks, walls, spreads, link) for name in columns])
    head = ["ranks", *(["thesis, 1000"] if with_thesis else []), *columns]
    return table(head, lines)


def cell(
    name: str, n_ranks: int, walls: dict[str, Wall], spreads: dict[str, Spread], link: Link
) -> str:
    if n_ranks <= 2 and name in walls:
        return seconds(walls[name].median(n_ranks))
    if name in spreads and spreads[name].case.fits(n_ranks):
        return f"*{seconds(spreads[name].seconds(n_ranks, link))}*"
    return "" if name not in spreads else "—"


def ends_table(spreads: dict[str, Spread], joined: list[Link]) -> str:
    """Return the best of the modelled numbers of ranks, and its speed-up."""
    lines = []
    for name, spread in spreads.items():
        best = [spread.best(link) for link in joined]
        lines.append([name, *(f"{gain:.1f} x on {n}" for n, gain in best)])
    return table(["", *(link.name for link in joined)], lines)


def link_table(joined: list[Link]) -> str:
    lines = [
        [
            link.name,
            seconds(link.overhead),
            seconds(link.message),
            f"{link.bandwidth / 1e9:.2g} GB/s",
        ]
        for link in joined
    ]
    return table(["", "overhead of an exchange", "a message", "bandwidth"], lines)


def make_table(spreads: dict[str, Spread], walls: dict[str, Wall], link: Link) -> str:
    """Return the inputs of the model, and its answer for two ranks next to the measured one."""
    lines = []
    for name, spread in spreads.items():
        i, seen = spread.ranks.index(2), spread.case.n_seen
        serial, divided = spread.parts()
        line = [
            name,
            f"{spread.n_exchanges[i] / seen:.1f}",
            f"{spread.n_bytes[i] / seen / 1e3:.3g} kB",
            f"{100 * serial / (serial + divided):.1f} %",
            seconds(spread.case.scale * spread.compute[0]),
            seconds(spread.seconds(2, link)),
        ]
        if name in walls:
            wall = walls[name]
            gain = median(a / b for a, b in zip(wall.one, wall.two, strict=True))
            waited = sum(wall.in_exchanges) / sum(wall.two)
            line += [seconds(wall.median(2)), number(gain), f"{100 * waited:.0f} %"]
        lines.append(line + [""] * (9 - len(line)))
    head = [
        "",
        "exchanges an observation",
        "exchanged an observation",
        "serial share",
        "one rank, CPU",
        "two, modelled",
        "two, measured",
        "one / two, measured",
        "in exchanges",
    ]
    return table(head, lines)
