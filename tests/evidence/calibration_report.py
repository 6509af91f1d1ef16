"""What the calibration gave: the tables of ``docs/evidence-calibration.md``.

Run with ``python -m tests.evidence.calibration_report`` from the root of the repository; with names
of estimators or targets behind it for their rows alone, the others being kept.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from pymc_statespace_filters.evidence.estimators import ESTIMATORS
from tests.evidence.calibration import CASES, Calibration, applies, calibrate

STATIC = Path(__file__).parents[2] / "docs" / "_static"
RESULTS, TABLE = STATIC / "evidence_calibration.csv", STATIC / "evidence_calibration.inc"
KEYS = ["target", "estimator"]
HEADS = (
    "target", "estimator", "bias", "reported error", "actual error", "mean z", "mean z²",
    "doubted", "evaluations", "verdict",
)  # fmt: skip


def verdict(result):
    """In a word or two, what a row says."""
    if np.isnan(result.reported):
        return "no error"
    if result.is_right:
        return "right"
    return "doubted" if result.doubted > 0.5 else "WRONG"


def table(results):
    """Markdown, a row for each pair, in the order of targets and estimators."""
    lines = [f"| {' | '.join(HEADS)} |", "| --- " * len(HEADS) + "|"]
    for target, case in CASES.items():
        title = target if case.n_runs == 200 else f"{target} ({case.n_runs} replications)"
        for estimator in ESTIMATORS:
            if (target, estimator) not in results:
                continue
            r = results[target, estimator]
            numbers = f"{r.bias:+.4f} | {r.reported:.4f} | {r.actual:.4f}"
            scores = f"{r.mean_z:+.2f} | {r.mean_square:.2f} | {r.doubted:.0%}"
            count = f"{r.n_evaluations:.0f}"
            lines.append(
                f"| {title} | {estimator} | {numbers} | {scores} | {count} | {verdict(r)} |"
            )
            title = ""
    return "\n".join(lines) + "\n"


def kept():
    """Results of earlier runs."""
    if not RESULTS.exists():
        return {}
    rows = pd.read_csv(RESULTS).set_index(KEYS)
    return {key: Calibration(**row) for key, row in rows.to_dict("index").items()}


def main(names):
    results = kept()
    for target, case in CASES.items():
        for name, estimator in ESTIMATORS.items():
            if applies(name, case) and (not names or {target, name} & set(names)):
                results[target, name] = calibrate(estimator, case.source, case.n_runs)
                frame = pd.DataFrame(
                    [dict(zip(KEYS, key, strict=True)) | r._asdict() for key, r in results.items()]
                )
                frame.to_csv(RESULTS, index=False, float_format="%.6g")
    TABLE.write_text(table(kept()))


if __name__ == "__main__":
    main(sys.argv[1:])
