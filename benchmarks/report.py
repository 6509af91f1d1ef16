"""Write the measurements to the tables and figures of the documentation."""

import csv
import json
import os
import platform
from pathlib import Path

from benchmarks import figures, integrators
from benchmarks.chains import ChainCost
from benchmarks.cold import Cold
from benchmarks.demo import Demo
from benchmarks.growth import Curve
from benchmarks.measure import FOLDER, ROOT, Row
from benchmarks.noise import Noise, Normals
from benchmarks.panel_evidence import PanelEvidence
from benchmarks.panel_nuts import DRAWS, N_RECORDS, PanelNuts
from benchmarks.panel_sampling import PanelChain
from benchmarks.ratios import ratios
from benchmarks.sampling import Chains

TARGET = ROOT / "docs" / "_static"
KINDS = {
    "sampling": lambda **row: (Chains if "sampler" in row else ChainCost)(**row),
    "particles": Curve,
    "steps": Curve,
    "states": Curve,
}
# Parts with a file of their own.
SEPARATE = {
    "ode": "benchmarks_ode.inc",
    "epidemic": "benchmarks_epidemic.inc",
    "panel": "benchmarks_panel.inc",
}
# Parts that need no other package.
OWN = {"normals": Normals, "noise": Noise, "cold": Cold, "demo": Demo, "panel_sampling": PanelChain}


def write(parts: list[str]) -> str:
    """Write all tables and figures whose parts are stored; return the tables as text."""
    kept = {part: json.loads((FOLDER / f"{part}.json").read_text()) for part in parts}
    if found := kept.pop("integrators", None):
        write_integrators(found["rows"])
    if found := kept.pop("panel_evidence", None):
        write_panel_evidence(found["rows"])
    if found := kept.pop("panel_nuts", None):
        write_panel_nuts(found)
    own = {part: k for part, k in kept.items() if part in OWN}
    separate = {part: k for part, k in kept.items() if part in SEPARATE}
    compared = {part: k for part, k in kept.items() if part not in OWN | SEPARATE}
    writers = ((write_comparison, compared), (write_own, own), (write_separate, separate))
    return "".join(write(parts) for write, parts in writers if parts)


def write_separate(kept: dict[str, dict]) -> str:
    """Write the table of each of these parts to its own file."""
    texts = []
    for part, k in kept.items():
        rows = [Row.of_json(row) for row in k["rows"]]
        texts.append(machine({part: k}) + likelihood_tables(rows))
        (TARGET / SEPARATE[part]).write_text(texts[-1])
    return "".join(texts)


def write_comparison(kept: dict[str, dict]) -> str:
    """Write the comparison with other packages, and the growth curves."""
    found = {
        part: [KINDS[part](**row) if part in KINDS else Row.of_json(row) for row in k["rows"]]
        for part, k in kept.items()
    }
    rows = [row for part in found if part not in KINDS for row in found[part]]
    sampled, *curves = (found.get(part, []) for part in KINDS)
    sampling = [row for row in sampled if isinstance(row, Chains)]
    growth = [curve for part in curves for curve in part]
    sections = [
        machine(kept),
        ratio_table(ratios(rows, growth, sampling)),
        likelihood_tables(rows),
        sampling_table(sampling),
        chain_table([row for row in sampled if isinstance(row, ChainCost)]),
    ]
    text = "\n".join(section for section in sections if section)
    (TARGET / "benchmarks.inc").write_text(text)
    write_csv(rows, TARGET / "benchmarks.csv")
    figures.bars(rows, TARGET / "benchmarks.png")
    figures.curves(growth, TARGET / "benchmarks_growth.png")
    return text


def write_own(kept: dict[str, dict]) -> str:
    """Write the tables that compare with no other package."""
    tables = {
        "normals": normals_table,
        "noise": noise_table,
        "cold": cold_table,
        "demo": demo_table,
        "panel_sampling": panel_table,
    }
    sections = [machine(kept)]
    sections += [
        tables[part]([OWN[part](**row) for row in kept[part]["rows"]])
        for part in OWN
        if part in kept
    ]
    text = "\n".join(sections)
    (TARGET / "benchmarks_own.inc").write_text(text)
    return text


def write_panel_evidence(rows: list[dict]) -> None:
    """Write the table of the page on panels, a line for each estimate."""
    lines = [
        [
            str(r.n_parameters),
            f"`{r.estimator}`",
            f"{r.error:.3f}",
            f"{r.se:.3f}",
            seconds(r.seconds),
        ]
        for r in (PanelEvidence(**row) for row in rows)
    ]
    head = ["parameters", "estimator", "error (nats)", "standard error", "time"]
    (TARGET / "panel_evidence.inc").write_text(table(head, lines))


def write_panel_nuts(kept: dict) -> None:
    """Write the table of NUTS on a panel."""
    lines = []
    for r in (PanelNuts(**row) for row in kept["rows"]):
        if r.seconds is None:
            lines.append([r.who, *[""] * 5, r.note])
            continue
        each = number(r.effective / r.seconds)
        whole = seconds(r.whole_call)
        answer = f"{r.log_likelihood:.3f}"
        lines.append([r.who, number(r.effective), seconds(r.seconds), each, whole, answer, r.note])
    head = [
        "",
        "effective draws",
        "tuning and draws",
        "a second",
        "whole call",
        "log-likelihood",
        "",
    ]
    text = f"\n## NUTS, {N_RECORDS} records, {DRAWS} + {DRAWS} iterations\n\n" + table(head, lines)
    (TARGET / "panel_nuts.inc").write_text(machine({"panel_nuts": kept}) + text)


def write_integrators(rows: list[dict]) -> None:
    """Write the table of the page on integrators."""
    text = integrators.table([integrators.Trial(**row) for row in rows])
    (TARGET / "integrators.inc").write_text(text)


def table(head: list[str], lines: list[list[str]]) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def machine(kept: dict[str, dict]) -> str:
    versions: dict[str, str] = {}
    for part in kept.values():
        versions |= part["versions"]
    loads = [part["load"] for part in kept.values()]
    listed = ", ".join(f"{name} {number}" for name, number in sorted(versions.items()))
    return (
        f"Measured on {cpu()} ({os.cpu_count()} cores, one used), {platform.system()}, Python "
        f"{platform.python_version()}; load average {min(loads):.1f} to {max(loads):.1f} "
        f"(1.0 is a quiet machine). Versions: {listed}.\n"
    )


def cpu() -> str:
    info = Path("/proc/cpuinfo")
    names = [
        line.split(":")[1].strip()
        for line in (info.read_text().split("\n") if info.exists() else [])
        if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or platform.machine()


def ratio_table(found: list[tuple[str, float | None, str]]) -> str:
    lines = [[what, number(ratio), meaning] for what, ratio, meaning in found]
    return "\n## Ratios\n\n" + table(["of", "ratio", ""], lines)


def likelihood_tables(rows: list[Row]) -> str:
    text = ["\n## Likelihoods\n"]
    for work in dict.fromkeys(row.work for row in rows):
        group = [row for row in rows if row.work == work]
        ours = best_of_ours(group)
        lines = [
            [
                row.who,
                seconds(row.timing.median),
                f"{seconds(row.timing.low)} to {seconds(row.timing.high)}",
                number(row.timing.median / ours) if ours else "",
                row.answer,
                row.note,
            ]
            if row.timing
            else [row.who, "not run", "", "", "", row.note]
            for row in group
        ]
        head = ["", "CPU time", "range", "times ours", "log-likelihood", ""]
        text.append(f"### {work}\n\n{table(head, lines)}")
    return "\n".join(text)


def best_of_ours(group: list[Row]) -> float | None:
    """Return the row that the others are divided by: ours, as a model uses it."""
    return next((row.timing.median for row in group if row.who == "ours" and row.timing), None)


def sampling_table(chains: list[Chains]) -> str:
    if not chains:
        return ""
    lines = [
        [
            c.sampler,
            f"{c.iterations_per_second:.0f}",
            f"{c.ess_per_second:.0f}",
            f"{c.ess_low:.0f} to {c.ess_high:.0f}",
            *(f"{n:.0f}" if n == n else "" for n in (c.kept_per_second, c.kept_ess_per_second)),
            c.note,
        ]
        if c.iterations_per_second == c.iterations_per_second
        else [c.sampler, "not run", *[""] * 4, c.note]
        for c in chains
    ]
    head = [
        "sampler",
        "draws per second",
        "smallest ESS per second",
        "over the seeds",
        "draws, tuning left out",
        "ESS, tuning left out",
        "",
    ]
    return "\n## Sampling\n\n" + table(head, lines)


def chain_table(rows: list[ChainCost]) -> str:
    if not rows:
        return ""
    lines = [[row.what, row.figure, row.note] for row in rows]
    return "\n### Compiled chains\n\n" + table(["", "", ""], lines)


def normals_table(rows: list[Normals]) -> str:
    lines = [[r.vectors, seconds(r.ours), seconds(r.numpy), number(r.numpy / r.ours)] for r in rows]
    head = ["compiled for vectors of", "a normal", "NumPy's standard_normal", "NumPy / ours"]
    return "\n## Normals\n\n" + table(head, lines)


def noise_table(rows: list[Noise]) -> str:
    lines = [
        [r.filter, r.system, seconds(r.fresh), seconds(r.held), number(r.fresh / r.held)]
        for r in rows
    ]
    head = ["filter", "system", "fresh noise", "held noise", "fresh / held"]
    return "\n## Fresh and held noise\n\n" + table(head, lines)


def cold_table(rows: list[Cold]) -> str:
    lines = [
        [r.kind, str(r.states or "")]
        + ["" if s is None else f"{s:.1f} s" for s in (r.first, r.second, r.another)]
        for r in rows
    ]
    head = ["", "states", "first call", "in a second process", "another model, same install"]
    return "\n## First calls\n\n" + table(head, lines)


def demo_table(rows: list[Demo]) -> str:
    lines = [[r.command, f"{r.first:.0f} s", f"{r.second:.0f} s"] for r in rows]
    return "\n## The demo\n\n" + table(["CPU time", "first run", "second run"], lines)


def panel_table(rows: list[PanelChain]) -> str:
    lines = [
        [str(r.n_records), r.moves, f"{100 * r.accepted:.1f} %", seconds(r.seconds)] for r in rows
    ]
    head = ["records", "moved", "iterations that move the first record", "1000 iterations"]
    return "\n## Panels with particles\n\n" + table(head, lines)


def write_csv(rows: list[Row], target: Path) -> None:
    with target.open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["work", "who", "seconds", "low", "high", "rounds", "answer", "note"])
        for row in rows:
            t = row.timing
            times = (
                [f"{t.median:.4g}", f"{t.low:.4g}", f"{t.high:.4g}", t.rounds] if t else [""] * 4
            )
            out.writerow([row.work, row.who, *times, row.answer, row.note])


def seconds(value: float) -> str:
    """Format seconds with three digits, in the unit that fits."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e9:.3g} ns"


def number(value: float | None) -> str:
    if value is None:
        return "not measured"
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}" if value >= 10 else f"{value:.2f}"
