"""check_site.py SITE: every link and picture of the built site leads to something in it, and no
page fetches anything from elsewhere.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

FETCHED = {
    ("img", "src"),
    ("script", "src"),
    ("link", "href"),
    ("iframe", "src"),
}


class Page(HTMLParser):
    """Links of a page, as (tag, attribute, target), and the names that it can be linked at."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors = [], set()
        self.feed(text)

    def has(self, anchor):
        """Whether there is such a place; the start of a page has no name."""
        return not anchor or anchor in self.anchors

    def handle_starttag(self, tag, attrs):
        """Collect what this tag links to."""
        given = dict(attrs)
        self.anchors |= {
            given[name] for name in ("id", "name") if given.get(name)
        }
        for name in ("href", "src"):
            if given.get(name):
                self.links.append((tag, name, given[name]))


def faults(site):
    """A line for each link that leads nowhere or fetches from elsewhere."""
    pages = {
        path: Page(path.read_text(encoding="utf-8"))
        for path in site.rglob("*.html")
    }
    for path, page in pages.items():
        for tag, name, target in page.links:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                if (tag, name) in FETCHED and parts.scheme != "data":
                    yield f"{path.relative_to(site)}: fetches {target}"
                continue
            start = site if parts.path.startswith("/") else path.parent
            found = (
                (start / unquote(parts.path).lstrip("/")).resolve()
                if parts.path
                else path
            )
            if not found.exists():
                yield f"{path.relative_to(site)}: no {target}"
            elif found in pages and not pages[found].has(
                unquote(parts.fragment)
            ):
                yield f"{path.relative_to(site)}: no place {target}"


def main(site):
    """Print all faults; returns how many there are."""
    found = sorted(set(faults(site.resolve())))
    for line in found:
        print(line)
    print(f"{len(list(site.rglob('*.html')))} pages, {len(found)} faults")
    return len(found)


if __name__ == "__main__":
    sys.exit(1 if main(Path(sys.argv[1])) else 0)
