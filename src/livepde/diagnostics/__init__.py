"""Checks for user-defined objects, and computable quantities of the paper's theory."""

import lazy_loader

# Loaded on first use, so that a run that needs a check does not load the theory.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
