"""Check a built site for broken links and anchors, for files loaded from other hosts, and for Markdown left as text.

    python scripts/docs/check_site.py [site]

zensical checks the links in the Markdown sources. This script checks the built HTML, including the parts that
mkdocstrings and templates add. Links to other hosts are allowed and are not requested.
"""

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# Resources that a browser fetches when it opens a page: attributes, by tag.
LOADED = {
    "script": ("src",),
    "img": ("src", "srcset"),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
    "audio": ("src",),
    "iframe": ("src",),
    "embed": ("src",),
    "object": ("data",),
    "track": ("src",),
    "input": ("src",),
    "use": ("href", "xlink:href"),
    "image": ("href", "xlink:href"),
}
LOADED_RELATIONS = {
    *("stylesheet", "icon", "shortcut", "apple-touch-icon", "manifest", "preload", "prefetch", "modulepreload"),
    *("preconnect", "dns-prefetch"),
}
IN_STYLES = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")
# A list or a table without a blank line before it, or a code fence that was not recognised.
LEFT_AS_TEXT = re.compile(r"\n(?:[-*] |\d+\. |\| )|^\| |```|^:::")


class Page(HTMLParser):
    """The contents of a page: its ids, links, loaded addresses and paragraphs."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.paragraphs: list[str] = []
        self._open: list[str] = []  # open tags whose text is collected

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the ids, links and loaded addresses of a tag."""
        given = {name: value or "" for name, value in attrs}
        self.ids |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and LOADED_RELATIONS & set(given.get("rel", "").lower().split()):
            self.loads.append(given.get("href", ""))
        for name in LOADED.get(tag, ()):
            if name in given:
                self.loads += [each.split()[0] for each in given[name].split(",") if each.strip()]
        self.loads += _in_style(given.get("style", ""))
        if tag == "p":
            self.paragraphs.append("")
        if tag in ("p", "style", "code"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """End the text of a paragraph."""
        if tag in self._open:
            while self._open.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        """Collect the text of paragraphs and the addresses loaded by styles."""
        if not self._open:
            return
        if self._open[-1] == "style":
            self.loads += _in_style(data)
        elif self._open[-1] == "p":
            self.paragraphs[-1] += data


def _in_style(text: str) -> list[str]:
    return [one or other for one, other in IN_STYLES.findall(text)]


def is_external(address: str) -> bool:
    """Whether an address names a host; a data URI does not."""
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme not in ("", "data", "blob", "javascript")


def read(path: Path) -> Page:
    """Return the parsed page of a file."""
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def problems(site: Path) -> list[str]:
    """Return all problems of a site, one line each; empty if there are none."""
    pages = {path: read(path) for path in sorted(site.rglob("*.html"))}
    if not pages:
        return [f"{site}: no page"]
    lines = []
    for path, page in pages.items():
        where = path.relative_to(site)
        lines += [f"{where}: loads {address}" for address in page.loads if is_external(address)]
        lines += [
            f"{where}: {problem}" for link in (*page.links, *page.loads) for problem in _broken(link, path, site, pages)
        ]
        lines += [
            f"{where}: Markdown left as text: {text.strip()[:80]!r}"
            for text in page.paragraphs
            if LEFT_AS_TEXT.search(text)
        ]
    for path in sorted(site.rglob("*.css")):
        named = _in_style(path.read_text(encoding="utf-8"))
        lines += [f"{path.relative_to(site)}: loads {address}" for address in named if is_external(address)]
    return list(dict.fromkeys(lines))


def _broken(link: str, path: Path, site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Yield the problem of a link within the site, if it has one."""
    if is_external(link) or link.startswith(("data:", "javascript:", "blob:")):
        return
    parts = urlsplit(link)
    aim = path
    if parts.path:
        # 404.html is shown for any address, so its links start at the root of the site.
        base = site if parts.path.startswith("/") else path.parent
        aim = (base / unquote(parts.path).lstrip("/")).resolve()
        aim = aim / "index.html" if aim.is_dir() else aim
    if not aim.is_file():
        yield f"broken link {link}"
    elif parts.fragment and aim in pages and unquote(parts.fragment) not in pages[aim].ids:
        yield f"no anchor for {link}"


def main() -> int:
    """Print all problems and their number; return True if there are any."""
    site = Path(sys.argv[1] if len(sys.argv) > 1 else "site").resolve()
    every = problems(site)
    sys.stdout.write("".join(f"{line}\n" for line in every))
    sys.stdout.write(f"{len(list(site.rglob('*.html')))} pages, {len(every)} problems\n")
    return bool(every)


if __name__ == "__main__":
    sys.exit(main())
