"""Access to MPI: the communicator for the argument ``comm``, with advice when there is none.

The only module that imports mpi4py, and only if a communicator is requested.
"""

import os
import sys
from typing import Any

from ..errors import ModelError, ParallelError

WORLD = "world"

# Variables with the number of ranks, set by the mpiexec of Open MPI, of MPICH and its derivatives,
# of MVAPICH, and by SLURM's srun.
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")
_RANK = "PMIX_RANK"  # set by any launcher that uses PMIx
# Modules that are loaded if the user's script, or `python -m mpi4py`, uses MPI.
_MPI_MODULES = ("mpi4py.MPI", "mpi4py.run")


def mpi() -> Any:
    """Return the module ``mpi4py.MPI``; a `ParallelError` if it or an MPI library is missing."""
    try:
        from mpi4py import MPI
    except ModuleNotFoundError as error:
        raise ParallelError(
            f"MPI needs {error.name}, which is not installed: install it by `pip install mpi4py`"
        ) from error
    except (ImportError, RuntimeError) as error:
        raise ParallelError(
            f"mpi4py finds no MPI library ({str(error).splitlines()[0]}). Install one by "
            "`pip install 'pymc-statespace-filters[mpi]'` or `apt install openmpi-bin`; on a "
            "cluster load its MPI first, as by `module load openmpi`."
        ) from error
    return MPI


def mpi_communicator(comm: Any) -> Any:
    """Resolve the argument ``comm`` of public functions to a communicator of mpi4py, or None.

    "world" is all ranks that were started together, or this process alone (None) if it was started
    neither by mpiexec nor by ``python -m mpi4py``, in which case mpi4py is not imported. Raises
    `ModelError` if it is something else, or a communicator that was freed; `ParallelError` if MPI
    is not available, or the launcher belongs to another MPI.
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
            "comm must be a communicator that this rank belongs to, got MPI.COMM_NULL: it was "
            "freed, or made by a Split without this rank"
        )
    if loaded is None or not isinstance(comm, loaded.Intracomm):
        raise ModelError(
            f"comm must be None, {WORLD!r} or an intracommunicator of mpi4py, got {comm!r}"
        )
    if not loaded.Is_initialized() or loaded.Is_finalized():
        when = "was already finalized" if loaded.Is_initialized() else "is not initialized"
        raise ParallelError(f"comm must be used between MPI.Init and MPI.Finalize, but MPI {when}")
    _check_launcher(loaded)
    return comm


def check_threads() -> None:
    """Raise a `ParallelError` unless several threads of this process may call MPI at once."""
    loaded = mpi()
    if loaded.Query_thread() < loaded.THREAD_MULTIPLE:
        raise ParallelError(
            "Ranks that run a chain together need an MPI that several threads may call at once "
            "(MPI_THREAD_MULTIPLE), but it was initialized for a lower thread level. Leave "
            "`mpi4py.rc.threads` and `mpi4py.rc.thread_level`, or the variables MPI4PY_RC_THREADS "
            "and MPI4PY_RC_THREAD_LEVEL, at their defaults; if they are, use another MPI library, "
            "or per_chain of 1."
        )


def _was_launched() -> bool:
    return (
        any(module in sys.modules for module in _MPI_MODULES)
        or _RANK in os.environ
        or any(size > 1 for size in _launched_sizes().values())
    )


def _launched_sizes() -> dict[str, int]:
    return {name: int(os.environ[name]) for name in _SIZES if os.environ.get(name, "").isdigit()}


def _check_launcher(loaded: Any) -> None:
    """Detect a launcher and MPI mismatch, in which every rank sees a world of size 1."""
    if loaded.COMM_WORLD.Get_size() > 1:
        return
    for name, size in _launched_sizes().items():
        if size > 1:
            library, _ = loaded.get_vendor()
            raise ParallelError(
                f"{size} ranks were started together ({name}={size}), but none sees the others: "
                f"mpi4py uses {library}, and the launcher belongs to another MPI. Start the ranks "
                f"by the mpiexec of {library} (`python -m mpi4py --mpi-library` prints its path), "
                "or by `srun --mpi=pmix`, or install mpi4py for the launcher's MPI."
            )
