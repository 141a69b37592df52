"""livepde: unknown parameters of a running, PDE-described process, identified as data stream in."""

import lazy_loader

__version__ = "0.1.0"

# Names in __init__.pyi, including packages, are loaded on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
