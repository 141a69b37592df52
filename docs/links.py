"""Follow every link inside of the site that `mkdocs build` has made, with: python docs/links.py."""

from __future__ import annotations

import sys
from pathlib import Path

from linkcheck.command import linkchecker

SITE = Path(__file__).resolve().parents[1] / "site"

if __name__ == "__main__":
    # Started by root it would go on as a user who may not read the folders of root.
    linkchecker.drop_privileges = lambda: None
    # What is broken is printed, and the exit code is 1.
    options = ["--no-status", "--no-warnings", "--ignore-url=sitemap", "--output=failures"]
    sys.argv[1:] = [*options, *(sys.argv[1:] or [str(SITE / "index.html")])]
    linkchecker.linkchecker()
