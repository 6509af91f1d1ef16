"""The tables of a whole study: run time against ranks, efficiency, and gathering on rank 0."""

from statistics import median

from benchmarks.mpi.model import makespan
from benchmarks.report import seconds, table

RANKS = (1, 2, 3, 4, 6, 12)


def study_table(found: dict) -> str:
    """Three rivals with four chains each: measured on one and two ranks, modelled beyond."""
    one, two = found["runs"]["1"], found["runs"]["2"]
    first = one[0]["evaluations"]
    evaluations = [n for chains in first.values() for n in chains]
    before = median(row["before"] for row in one)
    cost = median(sum(row["cpu"]) for row in one) / sum(evaluations)
    jobs = [cost * n for n in evaluations]
    measured = {1: median(row["wall"] for row in one), 2: median(row["wall"] for row in two)}
    lines = []
    for n in RANKS:
        modelled = before + makespan(jobs, n)
        lines.append(
            [
                str(n),
                f"{len(jobs) / n:g}",
                f"{measured[n]:.1f} s" if n in measured else "",
                f"*{modelled:.1f} s*",
                f"{(before + sum(jobs)) / modelled:.2f}",
            ]
        )
    text = (
        f"\n## A whole study\n\nThree rivals, four chains each, {seconds(min(jobs))} to "
        f"{seconds(max(jobs))} a chain, after {seconds(before)} in which every rank prepares the "
        f"models.\n\n"
    )
    return text + table(["ranks", "chains a rank", "measured", "modelled", "gain"], lines)


def efficiency_table(found: dict) -> str:
    """Return the work done per CPU second on two ranks, relative to one."""
    one, two = found["runs"]["1"], found["runs"]["2"]

    def ratio(of) -> list[float]:
        return [of(a) / of(b) for a, b in zip(one, two, strict=True)]

    rows = {
        "draws a CPU second, of sampling": ratio(lambda row: sum(row["cpu"])),
        "draws a CPU second, of whole processes": ratio(lambda row: row["process_cpu"]),
        "wall time, one / two, of sampling": ratio(lambda row: row["wall"] - row["before"]),
        "wall time, one / two, of whole processes": ratio(lambda row: row["process_wall"]),
    }
    lines = [
        [what, f"{median(values):.2f}", f"{min(values):.2f} to {max(values):.2f}"]
        for what, values in rows.items()
    ]
    return "\n### Two ranks over one\n\n" + table(["", "ratio", "range"], lines)


def gathering_table(one: dict, two: dict) -> str:
    """Return what gathering four chains of 100,000 draws of five parameters costs rank 0."""

    def peak(found: dict) -> str:
        return (
            f"{found['peak'][0]:.0f} MB, {found['peak'][0] / found['result'][0]:.2f} of the result"
        )

    lines = [
        ["rank 0 receives what the other has drawn", seconds(median(two["received"])), ""],
        ["the whole call", seconds(median(two["wall"])), seconds(median(one["wall"]))],
        ["the result", *(f"{found['result'][0]:.0f} MB" for found in (two, one))],
        ["peak of memory on rank 0 above what it had before", peak(two), peak(one)],
    ]
    head = ["", "two ranks", "one rank"]
    return "\n### Draws on their way to rank 0\n\n" + table(head, lines)
