"""Run the command line as `python -m livepde`."""

import sys

from livepde.cli import main

sys.exit(main())
