"""Ask a run how it is: exit code 0 if it is well, else 1. Usage: health.py URL."""

import os
import sys
import urllib.request

request = urllib.request.Request(sys.argv[1])
if token := os.environ.get("LIVEPDE_TOKEN"):
    request.add_header("Authorization", f"Bearer {token}")
try:
    with urllib.request.urlopen(request, timeout=5) as answer:
        sys.stdout.write(answer.read().decode() + "\n")
except OSError as error:  # refused, too late, or 503: not well
    sys.exit(f"{sys.argv[1]}: {error}")
