"""Look through the site that `mkdocs build` has made, with: python docs/links.py.

Nothing may be loaded from elsewhere, and every link inside of the site has to lead somewhere.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from linkcheck.command import linkchecker

SITE = Path(__file__).resolve().parents[1] / "site"
LOADED = re.compile(r'<(?:script|link|img|iframe|source)\b[^>]*?(?:src|href)="(?:https?:)?//[^"]*"')


def main(site: Path) -> None:
    """Print what is wrong; then the exit code is 1."""
    elsewhere = {item for page in site.rglob("*.html") for item in LOADED.findall(page.read_text())}
    if elsewhere:
        raise SystemExit("\n".join(["loaded from elsewhere:", *sorted(elsewhere)]))
    # Started by root it would go on as a user who may not read the folders of root.
    linkchecker.drop_privileges = lambda: None
    options = ["--no-status", "--no-warnings", "--ignore-url=sitemap", "--output=failures"]
    sys.argv[1:] = [*options, str(site / "index.html")]
    linkchecker.linkchecker()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else SITE)
