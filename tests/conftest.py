"""What every test run needs before numpy and PyTensor are imported."""

import os
from pathlib import Path

# One BLAS thread: the matrices are small, and the test processes already fill the cores.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# A compilation cache of the tests' own: they neither fill the user's cache nor are fed by it.
# No C compiler: numba needs none, and each operation that C code is made of takes a second. No BLAS
# to link C code against either: the search for one ends in a warning.
CACHE = Path(__file__).parents[1] / ".cache" / "pytensor"
os.environ.setdefault("PYTENSOR_FLAGS", f"base_compiledir={CACHE},blas__ldflags=,cxx=")

# Pictures are drawn without a screen.
os.environ.setdefault("MPLBACKEND", "agg")
