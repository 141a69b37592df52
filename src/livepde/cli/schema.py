"""The JSON schema of case files."""

from __future__ import annotations

import json

from livepde.cli.printing import terminal


def schema() -> None:
    """Print the JSON schema of case files: editors use it to complete and explain keys.

    The first line of a case names it: #:schema ./livepde.schema.json

    Example:  livepde schema > livepde.schema.json
    """
    from livepde.cases.json_schema import case_schema

    text = json.dumps(case_schema(), indent=1, ensure_ascii=False)
    terminal().print(text, markup=False, highlight=False, soft_wrap=True)
