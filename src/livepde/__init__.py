"""livepde: unknown parameters of a running, PDE-described process, identified as data stream in."""

from typing import Any

import lazy_loader

__version__ = "0.1.0"

PARTS = (
    "cases",
    "control",
    "dashboard",
    "diagnostics",
    "errors",
    "exchange",
    "fem",
    "laws",
    "linalg",
    "models",
    "observation",
    "parallel",
    "plots",
    "reproduce",
    "runs",
    "spaces",
    "stepping",
    "streams",
)

# What __init__.pyi names is loaded on first use, and so are the parts that are documented.
_exported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_part, *_ = lazy_loader.attach(__name__, PARTS)


def __getattr__(name: str) -> Any:
    return _part(name) if name in PARTS else _exported(name)
