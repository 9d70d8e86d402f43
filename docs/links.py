"""Check the built site: each link must have a target, and no page may fetch a resource from another site.

mkdocs only checks the links in Markdown. This hook checks the built pages, with reference, notebooks and menus.
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
FAR = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')\s]+)""")  # other sites in a style
NOT_LOADED = {"canonical", "prev", "next", "alternate"}  # values in <link rel=...>
LOG = logging.getLogger("mkdocs.hooks.links")  # its warnings make a strict build fail


class Page(HTMLParser):
    """The anchors and links of a page, and the addresses that a browser loads with it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.links, self.loaded = {"", "top"}, set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the anchors and addresses of one element."""
        has = {name: value or "" for name, value in attrs}
        self.anchors |= {has[name] for name in ("id", "name") if name in has}
        self.loaded |= {each.split()[0] for each in has.get("srcset", "").split(",") if each.strip()}
        if tag == "a" and "href" in has:
            self.links.add(has["href"])
        if LOADS.get(tag, "") in has and not NOT_LOADED & set(has.get("rel", "").split()):
            self.loaded.add(has[LOADS[tag]])


def fetched_by_styles(site: Path) -> Iterator[str]:
    """Yield a sentence for each resource of another site that a style, in a page or a file, would fetch."""
    for path in (*sorted(site.rglob("*.html")), *sorted(site.rglob("*.css"))):
        if "runs" not in (name := path.relative_to(site)).parts:
            yield from (f"{name} would fetch {address}" for address in sorted(set(FAR.findall(path.read_text()))))


def faults(site: Path) -> list[str]:
    """Return a sentence for each link without a target, and for each resource of another site that a page would fetch.

    The reports of the gallery's runs have separate tests, so that only their existence is checked. Resources that a
    script fetches at run time are not detected.
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
    """Log a warning for each fault."""
    for fault in faults(Path(config.site_dir)):
        LOG.warning(fault)
