"""Run the command line as `python -m livepde`, or as the installed program."""

import gc
import sys


def main() -> int:
    """Import the command line and run it; return its exit code."""
    # Imported modules are never garbage. Collections during the import take a seventh of the time
    # to start; without `freeze`, later collections would examine the modules again.
    gc.disable()
    from livepde import cli

    gc.freeze()
    gc.enable()
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
