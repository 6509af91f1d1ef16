"""The filters, and what your own filter needs: the contract in `protocol`, and base classes.

`EnsembleFilterBase` and `ParticleFilter` with `member_filter` give a filter with members everything
but its update; a filter of another kind satisfies `Filter` by itself.
"""

import lazy_loader

# A name is imported when it is first used, so that one filter does not load the others.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
