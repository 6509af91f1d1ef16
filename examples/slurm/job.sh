#!/bin/bash
# Three models of four chains: 12 ranks run all chains at once. What follows `sbatch job.sh` goes to
# study.py. How modules and partitions are called, the cluster's pages say.
#SBATCH --job-name=double-well
#SBATCH --ntasks=12
#SBATCH --cpus-per-task=1
#SBATCH --time=02:00:00
#SBATCH --requeue            # what was drawn is in the checkpoint, also after another sbatch
#SBATCH --open-mode=append
#SBATCH --output=double-well.log

set -euo pipefail

# The cluster's MPI and an environment whose mpi4py finds it, made once by
#     python -m venv ~/study && ~/study/bin/pip install pymc-statespace-filters
module load openmpi
source ~/study/bin/activate

# A rank runs on as many processors as it has chains at a time: no library starts more threads.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1

# The log is a file, though mpiexec gives ranks a terminal: progress is written once, at the end.
export TERM=dumb

# Compiled models on each computer's own disk: one rank of each compiles, the others find it.
export PYTENSOR_FLAGS="${PYTENSOR_FLAGS:-base_compiledir=${TMPDIR:-/tmp}/pytensor-$USER}"

# On computers with different processors, for the same machine code and so the same bits:
# export NUMBA_CPU_NAME=x86-64-v3 NUMBA_CPU_FEATURES=

# The launcher of the MPI that mpi4py uses; `srun --mpi=pmix` in its place binds ranks as SLURM does.
# With `-m mpi4py` an error on one rank ends the job and does not leave the others waiting.
mpiexec -n "$SLURM_NTASKS" python -m mpi4py study.py "$@"
