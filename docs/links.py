"""Looks at the site once it is built: does each link lead somewhere, and is nothing fetched from elsewhere?

mkdocs looks at the links of Markdown alone. This looks at the pages themselves: reference, notebooks and menus too.
"""

import logging
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

LOADS = {
    "script": "src",
    "link": "href",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "embed": "src",
    "object": "data",
}
FAR = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')\s]+)""")  # what a style fetches
NOT_LOADED = {"canonical", "prev", "next", "alternate"}  # of <link rel=...>
LOG = logging.getLogger("mkdocs.hooks.links")  # a warning there ends a strict build


class Page(HTMLParser):
    """What a page can be linked to by, what it links to, and what a browser loads with it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.links, self.loaded = {"", "top"}, set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the anchors and addresses of one element."""
        has = {name: value or "" for name, value in attrs}
        self.anchors |= {has[name] for name in ("id", "name") if name in has}
        self.loaded |= {each.split()[0] for each in has.get("srcset", "").split(",") if each.strip()}
        if tag == "a" and "href" in has:
            self.links.add(has["href"])
        if LOADS.get(tag, "") in has and not NOT_LOADED & set(has.get("rel", "").split()):
            self.loaded.add(has[LOADS[tag]])


def fetched_by_styles(site: Path) -> Iterator[str]:
    """A sentence for each thing that a style, in a page or in a file, would fetch from elsewhere."""
    for path in (*sorted(site.rglob("*.html")), *sorted(site.rglob("*.css"))):
        if "runs" not in (name := path.relative_to(site)).parts:
            yield from (f"{name} would fetch {address}" for address in sorted(set(FAR.findall(path.read_text()))))


def faults(site: Path) -> list[str]:
    """A sentence for each link that leads nowhere, and for each thing that a page would fetch from elsewhere.

    The reports of the gallery's runs have tests of their own: only that they are there is looked at. What a script
    fetches when it runs is not seen.
    """
    paths = [path for path in sorted(site.rglob("*.html")) if "runs" not in path.relative_to(site).parts]
    pages = {path.resolve(): Page(path.read_text()) for path in paths}
    found = list(fetched_by_styles(site.resolve()))
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        for address in sorted(page.loaded):
            if urlsplit(address).scheme not in ("", "data") or address.startswith("//"):
                found.append(f"{name} would fetch {address}")
        for address in sorted(page.links | page.loaded):
            parts = urlsplit(address)
            if parts.scheme or address.startswith("//"):
                continue
            base = site.resolve() if parts.path.startswith("/") else path.parent
            target = (base / unquote(parts.path).lstrip("/")).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.is_file():
                found.append(f"{name} links to {address}, which is not there")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{name} links to {address}: that page has no such place")
    return found


def on_post_build(config: Any) -> None:
    """Warn of each fault."""
    for fault in faults(Path(config.site_dir)):
        LOG.warning(fault)
