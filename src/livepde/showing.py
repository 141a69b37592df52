"""Representation of objects as text in a terminal and as HTML in a notebook."""

from __future__ import annotations

import ast
import dataclasses
import html
import inspect
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

MOST = 8  # largest number of names in a line
LONG = 200  # largest number of characters of an expression


class Shown(ABC):
    """An object whose `repr`, and whose HTML in a notebook, is a title with named rows."""

    @abstractmethod
    def _shown(self) -> tuple[str, Mapping[str, str]]:
        """Return the title and the rows, name -> text."""

    def __repr__(self) -> str:
        """Return the title and one line for each row."""
        title, rows = self._shown()
        return "\n".join([title, *(f"  {name}: {text}" for name, text in rows.items())])

    def _repr_html_(self) -> str:
        """Return the title and a table of the rows as HTML, for notebooks."""
        title, rows = self._shown()
        cells = "".join(
            f'<tr><th style="text-align:left">{html.escape(name)}</th>'
            f'<td style="text-align:left">{html.escape(text)}</td></tr>'
            for name, text in rows.items()
        )
        return f"<b>{html.escape(title)}</b><table>{cells}</table>"


def in_percent(share: float) -> str:
    """Format a share in per cent, with two digits and without exponent.

    >>> in_percent(0.0234), in_percent(0.997), in_percent(2.5)
    ('2.3 %', '100 %', '250 %')
    """
    size = 100.0 * share
    return f"{size:.0f} %" if abs(size) >= 99.5 else f"{size:.2g} %"


def listed(names: Iterable[str]) -> str:
    """Join names by commas; of more than `MOST` names, list the first and the count.

    >>> listed("ab"), listed("abcdefghij")
    ('a, b', 'a, b, c, d, e, f, g, h, ... (10)')
    """
    names_list = list(names)
    rest = f", ... ({len(names_list)})" if len(names_list) > MOST else ""
    return ", ".join(names_list[:MOST]) + rest


def options_of(value: Any) -> str:
    """Return a dataclass as text, with the options that differ from their defaults."""
    texts = []
    for field in dataclasses.fields(value) if dataclasses.is_dataclass(value) else ():
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        value_of_field = getattr(value, field.name)
        if field.init and repr(value_of_field) != repr(default):
            texts.append(f"{field.name}={value_of_field!r}")
    return f"{type(value).__name__}({', '.join(texts)})"


def expression(function: Callable[..., Any]) -> str:
    """Return the source of the expression that a function returns; if not available, its name.

    >>> expression(len)
    'len(...)'
    """
    name = f"{getattr(function, '__name__', type(function).__name__)}(...)"
    code = getattr(function, "__code__", None)
    if code is None:
        return name
    try:
        source = textwrap.dedent(inspect.getsource(function))
        expressions = list(_returned(source, list(code.co_varnames[: code.co_argcount])))
    except (OSError, SyntaxError, TypeError):
        return name
    # Functions with the same arguments in one statement cannot be distinguished.
    return expressions[0] if len(expressions) == 1 and len(expressions[0]) <= LONG else name


def _returned(source: str, arguments: list[str]) -> Iterator[str]:
    """Iterate over the expressions that functions in `source` with these arguments return."""
    for node in ast.walk(_parsed(source)):
        if not isinstance(node, ast.Lambda | ast.FunctionDef):
            continue
        if [argument.arg for argument in node.args.args] != arguments:
            continue
        if isinstance(node, ast.Lambda):
            yield ast.unparse(node.body)
        elif isinstance(node.body[-1], ast.Return) and node.body[-1].value is not None:
            single = len(node.body) - (ast.get_docstring(node) is not None) == 1
            yield ast.unparse(node.body[-1].value) if single else f"{node.name}(...)"


def _parsed(source: str) -> ast.AST:
    """Return the syntax tree of source code, which may be only the arguments of a call."""
    try:
        return ast.parse(source)
    except SyntaxError:  # a line of a call, such as `A=lambda ...,`
        return ast.parse(f"_({source.rstrip().rstrip(',)')})")
