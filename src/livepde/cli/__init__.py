"""The command line. Exit codes: 0 success, 1 a check failed, 2 bad input, 130 interrupted."""

from livepde.cli.program import app, main

__all__ = ["app", "main"]
