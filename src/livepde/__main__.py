"""Run the command line as `python -m livepde`."""

from livepde.cli import main

main()
