"""Static detection of unused arguments from the byte code of a function."""

from __future__ import annotations

from dis import get_instructions
from inspect import unwrap
from types import FunctionType
from typing import Any

__all__ = ["reads"]


def reads(function: Any, position: int) -> bool:
    """Return False if a function never uses the argument at a position; True if it may."""
    function = unwrap(function)
    if not isinstance(function, FunctionType) or function.__code__.co_argcount <= position:
        return True
    code = function.__code__
    name = code.co_varnames[position]
    used = [item.argval for item in get_instructions(code) if item.opname.count("FAST")]
    named = [name in item if isinstance(item, tuple) else item == name for item in used]
    return any(named) or name in code.co_cellvars
