"""What the calibration gave: the tables of ``docs/evidence-calibration.md``.

Run with ``python -m tests.evidence.calibration_report`` from the root of the repository; with names
of estimators or targets behind it for their rows alone, the others being kept.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from pymc_statespace_filters.evidence.estimation import ESTIMATORS
from tests.evidence.calibration import CASES, LONG_CHAINS, Calibration, applies, calibrate

STATIC = Path(__file__).parents[2] / "docs" / "_static"
RESULTS = STATIC / "evidence_calibration.csv"
TABLE, LONG_TABLE = STATIC / "evidence_calibration.inc", STATIC / "evidence_long_chains.inc"
KEYS = ["target", "estimator"]
HEADS = (
    "target (replications)", "estimator", "bias", "reported error", "actual error",
    "mean z", "mean z²", "doubted", "evaluations", "verdict",
)  # fmt: skip


def verdict(result):
    """In a word or two, what a row says."""
    if np.isnan(result.reported):
        return "no error"
    if result.is_right:
        return "right"
    return "doubted" if result.doubted > 0.5 else "WRONG"


def table(cases, results):
    """Markdown, a row for each pair, in the order of targets and estimators."""
    lines = [f"| {' | '.join(HEADS)} |", "| --- " * len(HEADS) + "|"]
    for target, case in cases.items():
        title = f"{target} ({case.n_runs})"
        for estimator in ESTIMATORS:
            if (target, estimator) not in results:
                continue
            r = results[target, estimator]
            numbers = f"{r.bias:+.4f} | {r.reported:.4f} | {r.actual:.4f}"
            scores = f"{r.mean_z:+.2f} | {r.mean_square:.2f} | {r.doubted:.0%}"
            lines.append(
                f"| {title} | {estimator} | {numbers} | {scores} | {r.n_evaluations:.0f} "
                f"| {verdict(r)} |"
            )
            title = ""
    return "\n".join(lines) + "\n"


def kept():
    """Results of earlier runs, by target and estimator."""
    if not RESULTS.exists():
        return {}
    rows = pd.read_csv(RESULTS).set_index(KEYS)
    return {key: Calibration(**row) for key, row in rows.to_dict("index").items()}


def main(names):
    results = kept()
    for target, case in (CASES | LONG_CHAINS).items():
        for name, estimator in ESTIMATORS.items():
            if not applies(name, case) or (names and not {target, name} & names):
                continue
            results[target, name] = calibrate(estimator, case.source, case.n_runs)
            rows = [dict(zip(KEYS, key, strict=True)) | r._asdict() for key, r in results.items()]
            pd.DataFrame(rows).to_csv(RESULTS, index=False, float_format="%.6g")
    for cases, path in ((CASES, TABLE), (LONG_CHAINS, LONG_TABLE)):
        path.write_text(table(cases, kept()))


if __name__ == "__main__":
    main(set(sys.argv[1:]))
