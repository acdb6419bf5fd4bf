"""Check a built site: what its pages load and link to lies in its folder: python tools/check_site.py FOLDER.

A page may link to another site, for the reader to follow; it may load nothing from there. Exits with 1 on a problem.
"""

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"src", "srcset", "poster", "data"}  # attributes whose target the browser fetches by itself
STYLE = re.compile(r"""(?:@import\s+(?:url\()?|url\()\s*["']?(?!data:|#)([^"')\s]+)""")


class Page(HTMLParser):
    """Addresses that an HTML page loads and links to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.places: set[str] = set()  # anchors
        self.feed(text)
        self.loaded += STYLE.findall(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the targets of a tag."""
        for name, value in attrs:
            if name == "id" and value:
                self.places.add(value)
            elif value and (name in LOADED or (name == "href" and tag == "link")):
                self.loaded.append(value)
            elif value and name == "href":
                self.linked.append(value)


def problems(site: Path) -> Iterator[str]:
    """Yield a sentence for each thing loaded from elsewhere and for each link that leads nowhere."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        yield from (f"{path}: loads {target}" for target in page.loaded if is_elsewhere(target))
        for target in (*page.loaded, *page.linked):
            if is_elsewhere(target) or target.startswith(("data:", "mailto:", "javascript:")):
                continue
            parts = urlsplit(target)
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path.resolve()
            file = file / "index.html" if file.is_dir() else file
            if not file.is_file():
                yield f"{path}: links to {target}, which is not there"
            elif parts.fragment and file.suffix == ".html" and target in page.linked:
                found = pages.get(site / file.relative_to(site.resolve()))
                if found is not None and unquote(parts.fragment) not in found.places:
                    yield f"{path}: links to {target}, whose place is not there"
    for path in sorted(site.rglob("*.css")):
        styles = STYLE.findall(path.read_text(encoding="utf-8"))
        yield from (f"{path}: loads {target}" for target in styles if is_elsewhere(target))


def is_elsewhere(target: str) -> bool:
    """Return whether a target is on another machine."""
    return target.startswith(("http:", "https:", "//"))


if __name__ == "__main__":
    found = list(problems(Path(sys.argv[1])))
    print("\n".join(found) or f"{sys.argv[1]}: loads nothing from elsewhere, and no link is broken")
    sys.exit(bool(found))
