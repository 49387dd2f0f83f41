"""Check a built site: every link inside it leads somewhere, and nothing is loaded from elsewhere.

python docs/check_links.py build/docs
"""

from __future__ import annotations

import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Elements whose address is fetched as soon as a page is opened, not when somebody clicks.
LOADED = {"script", "img", "iframe", "source", "link"}


class Page(HTMLParser):
    """The anchors of a page, and where it points."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[tuple[str, str]] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep ids and addresses."""
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value:
                self.links.append((tag, value))


def broken(site: Path) -> list[str]:
    """Return what is wrong, a line each."""
    page = cache(Page)
    wrong = []
    for path in sorted(site.rglob("*.html")):
        for tag, link in page(path).links:
            url = urlsplit(link)
            where = f"{path.relative_to(site)}: <{tag}> {link}"
            if url.scheme or url.netloc:
                if tag in LOADED and url.scheme != "data":
                    wrong.append(f"{where}: loaded from elsewhere")
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            if not target.is_file():
                wrong.append(f"{where}: no such file")
            elif url.fragment and unquote(url.fragment) not in page(target).anchors:
                wrong.append(f"{where}: no such place on the page")
    return wrong


if __name__ == "__main__":
    found = broken(Path(sys.argv[1]).resolve())
    print("\n".join(found) or "every link leads somewhere, nothing is loaded from elsewhere")
    sys.exit(bool(found))
