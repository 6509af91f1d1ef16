"""The filters, and what your own filter needs: base classes, and what its three functions call.

`member_filter` makes one of the functions; `PartsFilter` is the base of a filter with a single
Gaussian, `ParticleFilter` or `EnsembleFilterBase` that of a filter with members. `njit_internal`
compiles what these functions call, and `linalg` has Cholesky factors of small matrices.
"""

import lazy_loader

# A name is imported when it is first used, so that one filter does not load the others.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
