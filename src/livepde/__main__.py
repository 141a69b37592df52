"""Run the command line as `python -m livepde`, or as the installed program."""

import gc
import sys


def main() -> int:
    """Import the command line and run it; return its exit code."""
    # What is imported is never garbage: to look for some in it, over and over, takes a seventh of
    # the start, and more later on.
    gc.disable()
    from livepde import cli

    gc.freeze()
    gc.enable()
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
