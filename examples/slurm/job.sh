#!/bin/bash
# Three models with four chains each: 12 ranks run all chains at once. Arguments after `sbatch job.sh`
# are passed to study.py. See your cluster's documentation for the names of modules and partitions.
#SBATCH --job-name=double-well
#SBATCH --ntasks=12
#SBATCH --cpus-per-task=1
#SBATCH --time=02:00:00
#SBATCH --requeue            # a requeued job, or a new sbatch, resumes from the checkpoint
#SBATCH --open-mode=append
#SBATCH --output=double-well.log

set -euo pipefail

# The cluster's MPI and an environment whose mpi4py finds it, created once by
#     python -m venv ~/study && ~/study/bin/pip install pymc-statespace-filters
module load openmpi
source ~/study/bin/activate

# A rank uses one processor per chain it runs at a time: libraries must not start more threads.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1

# The log is a file, but mpiexec gives ranks a terminal. With TERM=dumb progress is written once, at the end.
export TERM=dumb

# Store compiled models on each node's own disk: one rank per node compiles, the others load.
export PYTENSOR_FLAGS="${PYTENSOR_FLAGS:-base_compiledir=${TMPDIR:-/tmp}/pytensor-$USER}"

# On nodes with different processors, for the same machine code and so the same bits:
# export NUMBA_CPU_NAME=x86-64-v3 NUMBA_CPU_FEATURES=

# The launcher of the MPI that mpi4py uses; `srun --mpi=pmix` in its place lets SLURM bind the ranks.
# With `-m mpi4py` an error on one rank ends the job instead of leaving the others waiting.
mpiexec -n "$SLURM_NTASKS" python -m mpi4py study.py "$@"
