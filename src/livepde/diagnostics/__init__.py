"""Checks that a user can run on objects of his own, and the paper's theory made computable."""

import lazy_loader

# What __init__.pyi names is loaded on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
