"""livepde: unknown parameters of a running, PDE-described process, identified as data stream in."""

import lazy_loader

__version__ = "0.1.0"

# What __init__.pyi names, packages among it, is loaded on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
