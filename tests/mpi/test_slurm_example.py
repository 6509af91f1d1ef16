"""The example of a batch job: as it stands, without SLURM, beside the same script on a laptop."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd

from tests.mpi.launch import ROOT, SETTINGS
from tests.waiting import LIMIT

EXAMPLE = ROOT / "examples" / "slurm"
BIN = Path(sys.executable).parent


def run(command, **environment):
    done = subprocess.run(
        command,
        cwd=EXAMPLE,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_job_gives_what_a_laptop_gives(tmp_path):
    # What a cluster has and this machine has not.
    (tmp_path / "study" / "bin").mkdir(parents=True)
    (tmp_path / "study" / "bin" / "activate").write_text(f'PATH="{BIN}:$PATH"\n')
    (tmp_path / "cluster.sh").write_text("module() { :; }\n")
    printed = run(
        ["bash", "job.sh", "--quick", "--out", tmp_path / "cluster"],
        **SETTINGS,
        HOME=str(tmp_path),
        BASH_ENV=str(tmp_path / "cluster.sh"),
        SLURM_NTASKS="2",
    )
    run([sys.executable, "study.py", "--quick", "--out", tmp_path / "laptop"])
    # How much of the filter is checked at the end of a run, and so what is doubted, is a share of
    # the time that the run took.
    there, here = (
        pd.read_csv(tmp_path / name / "model_probabilities.csv", index_col="model").drop(
            columns="warning"
        )
        for name in ("cluster", "laptop")
    )
    pd.testing.assert_frame_equal(there, here, check_exact=True)
    assert there.index[0] == "M2"
    assert printed.count("M2") == 1  # the table, once
