"""What the calibration gave: the tables of ``docs/reference/evidence-calibration.md``.

Run with ``python -m tests.evidence.calibration_report`` from the root of the repository; with names
of estimators, of targets or of both behind it for their rows alone, the others being kept.
"""

import sys
from pathlib import Path

import pandas as pd

from tests.evidence.calibration import (
    CALIBRATED,
    CASES,
    LONG_CHAINS,
    Calibration,
    applies,
    calibrate,
)

STATIC = Path(__file__).parents[2] / "docs" / "_static"
RESULTS = STATIC / "evidence_calibration.csv"
TABLE, LONG_TABLE = STATIC / "evidence_calibration.inc", STATIC / "evidence_long_chains.inc"
DOUBTS_TABLE = STATIC / "evidence_doubts.inc"
KEYS = ["target", "estimator"]
HEADS = (
    "target", "estimator", "runs", "bias", "reported error", "actual error",
    "mean z", "mean z²", "doubted", "evaluations", "verdict",
)  # fmt: skip


def verdict(result):
    """In a word or two, what a row says."""
    if result.is_right:
        return "right"
    return "doubted" if result.doubted > 0.5 else "outside"


def table(cases, results):
    """Markdown, a row for each pair, in the order of targets and estimators."""
    lines = [f"| {' | '.join(HEADS)} |", "| --- " * len(HEADS) + "|"]
    for target in cases:
        title = target
        for estimator in CALIBRATED:
            if (target, estimator) in results:
                lines.append(row(title, estimator, results[target, estimator]))
                title = ""
    return "\n".join(lines) + "\n"


def row(title, estimator, r):
    """One of them."""
    cells = (
        title, estimator, r.n_runs, f"{r.bias:+.4f}", f"{r.reported:.4f}", f"{r.actual:.4f}",
        f"{r.mean_z:+.2f}", f"{r.mean_square:.2f}", f"{r.doubted:.0%}", f"{r.n_evaluations:.0f}",
        verdict(r),
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def table_of_doubts(results):
    """How often an estimator doubts itself where it is right, and does not where it is wrong."""
    lines = ["| estimator | right rows | falsely doubted | wrong rows | doubt missed |"]
    lines.append("| --- " * 5 + "|")
    for estimator in CALIBRATED:
        rows = [r for (_, name), r in results.items() if name == estimator]
        right = [r for r in rows if r.is_right]
        wrong = [r for r in rows if not r.is_right]
        cells = len(right), share_of_runs(right, 1), len(wrong), share_of_runs(wrong, 0)
        lines.append(f"| {estimator} | {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def share_of_runs(rows, doubted):
    """How many runs of these rows were doubted (1) or not (0), of how many."""
    n_runs = sum(r.n_runs for r in rows)
    found = sum(r.n_runs * (r.doubted if doubted else 1.0 - r.doubted) for r in rows)
    return f"{found:.0f} of {n_runs} runs" if rows else ""


def kept():
    """Results of earlier runs, by target and estimator."""
    if not RESULTS.exists():
        return {}
    rows = pd.read_csv(RESULTS).set_index(KEYS)
    return {key: Calibration(**row) for key, row in rows.to_dict("index").items()}


def keep(results):
    rows = [dict(zip(KEYS, key, strict=True)) | r._asdict() for key, r in results.items()]
    pd.DataFrame(rows).to_csv(RESULTS, index=False, float_format="%.6g")


def main(names):
    cases = CASES | LONG_CHAINS
    targets = names & cases.keys() or cases.keys()
    estimators = names & CALIBRATED.keys() or CALIBRATED.keys()
    if unknown := names - targets - estimators:
        raise SystemExit(f"neither of {list(cases)} nor of {list(CALIBRATED)}: {unknown}")
    for target, case in cases.items():
        for name, estimator in CALIBRATED.items():
            if target in targets and name in estimators and applies(name, case):
                found = calibrate(estimator, case.source, case.n_runs)
                keep(kept() | {(target, name): found})
    TABLE.write_text(table(CASES, kept()))
    LONG_TABLE.write_text(table(LONG_CHAINS, kept()))
    DOUBTS_TABLE.write_text(table_of_doubts(kept()))


if __name__ == "__main__":
    main(set(sys.argv[1:]))
