"""Check the site built by `mkdocs build`, with: python docs/links.py.

No page may load resources from another server, and every internal link must have a target.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from linkcheck.command import linkchecker

SITE = Path(__file__).resolve().parents[1] / "site"
LOADED = re.compile(r'<(?:script|link|img|iframe|source)\b[^>]*?(?:src|href)="(?:https?:)?//[^"]*"')


def main(site: Path) -> None:
    """Print the faults of a site; the exit code is 1 if there are any."""
    elsewhere = {item for page in site.rglob("*.html") for item in LOADED.findall(page.read_text())}
    if elsewhere:
        raise SystemExit("\n".join(["loaded from elsewhere:", *sorted(elsewhere)]))
    # If root starts it, linkchecker changes to a user who cannot read root's folders.
    linkchecker.drop_privileges = lambda: None
    options = ["--no-status", "--no-warnings", "--ignore-url=sitemap", "--output=failures"]
    sys.argv[1:] = [*options, str(site / "index.html")]
    linkchecker.linkchecker()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else SITE)
