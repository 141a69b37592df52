"""Weak forms as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from livepde.fem.fields import On
from livepde.showing import expression


def no_term(u: Any, v: Any, x: Any) -> Any:
    """The zero form."""
    return 0.0 * x[0]


def terms_text(given: Any) -> list[str]:
    """Return the terms of a form as source code."""
    terms = given if isinstance(given, Sequence) else [given]
    return [
        f"{terms_text(term.form)[0]} on {term.name!r}" if isinstance(term, On) else expression(term)
        for term in terms
        if term is not no_term
    ]


def equation_text(parts: Mapping[str, Any]) -> str:
    """Return the weak form of the process as text."""
    mass = "u' * v" if parts["M"] is None else "M(u', v)"
    left = " + ".join([mass, *terms_text(parts["A"]), *terms_text(parts["B"])])
    source = parts["f"]
    sources = [
        str(item) if isinstance(item, int | float | Mapping) else terms_text(item)[0]
        for item in (source if isinstance(source, Sequence) else [source])
        if item != 0.0
    ]
    right = f"integral of ({' + '.join(sources)}) * v" if sources else "0"
    return f"integral of {left} = {right}"
