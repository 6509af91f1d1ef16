"""Our side of the communication with another package in its own process."""

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}


class PeerError(Exception):
    """A package that is not installed, or that failed; the message is one line."""


class Peer:
    """A file of this folder, running in its environment, that serves one request at a time."""

    def __init__(self, name: str, environment: Path, records: Path) -> None:
        python = environment / "bin" / "python"
        if not python.exists():
            raise PeerError(f"no environment {environment.name}")
        root = Path(__file__).parents[2]
        self.log = records.parent / f"{name}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [python, "-W", "ignore", "-m", f"benchmarks.peers.{name}", records],
                cwd=root,
                env=os.environ | ONE_THREAD | {"PYTHONPATH": str(root), "MPLBACKEND": "agg"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self.versions: dict[str, str] = self._answer()["versions"]

    def ask(self, *words: object) -> dict:
        print(*words, file=self.process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> dict:
        line = self.process.stdout.readline()
        if not line:
            last = self.log.read_text().strip().split("\n")[-1]
            raise PeerError(last[:200] or "the process ended without a word")
        answer = json.loads(line)
        if "error" in answer:
            raise PeerError(answer["error"])
        return answer

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


@dataclass
class RemoteTask:
    """One task of a peer, timed like a function of this process."""

    peer: Peer
    task: str
    first: float = 0.0

    def warm_up(self) -> None:
        self.first = self.peer.ask("prepare", self.task)["first"]

    def values(self, n_seeds: int) -> list[float]:
        return self.peer.ask("values", self.task, n_seeds)["values"]

    def seconds(self) -> float:
        return self.peer.ask("time", self.task)["seconds"]
