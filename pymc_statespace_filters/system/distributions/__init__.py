"""The laws of noise: what replaces a random variable in a graph, by its kind.

They load PyMC, and so are imported when the first distribution is met.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
