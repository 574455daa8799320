"""Crawls the built site: dead links, requests to other hosts, formulas that stayed source text.

Usage: python docs/check_site.py [FOLDER]

A Chromium, where there is one, opens index.html and every page with formulas.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

SITE = Path(__file__).resolve().parents[1] / "build" / "site"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOURCE = ("code", "pre", "script", "style")
"""Elements whose text is no prose."""
LEFT_OVER = re.compile(r"\$|\\[(\[a-zA-Z]|`|\n *[-*] ")
"""Formulas, code and lists that stayed Markdown."""
IN_STYLE = re.compile(r"(?:url\(|@import )\s*[\"']?([^\"')\s]+)")


class Page(HTMLParser):
    """What a page links to and requests, its anchors, and prose that looks like Markdown."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.links: list[str] = []
        self.requests: list[str] = []
        self.anchors: set[str] = set()
        self.left_over: list[str] = []
        self.formulas = 0
        self._source_depth = 0
        self._in_formula = False
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        self._source_depth += tag in SOURCE
        self._in_formula = given.get("class") == "arithmatex"
        self.formulas += self._in_formula
        self.requests += [given[name] for name in ("src", "data", "poster") if name in given]
        self.requests += IN_STYLE.findall(given.get("style", ""))
        if "href" in given and given.get("rel") not in ("prev", "next"):
            (self.links if tag == "a" else self.requests).append(given["href"])

    def handle_endtag(self, tag: str) -> None:
        self._source_depth -= tag in SOURCE
        self._in_formula = False

    def handle_data(self, data: str) -> None:
        if not self._source_depth and not self._in_formula and LEFT_OVER.search(data):
            self.left_over.append(" ".join(data.split()))


def read_pages(site: Path) -> dict[Path, Page]:
    """All pages but 404.html, which is for web servers: its links begin at their root."""
    return {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}


def problems(site: Path) -> Iterator[str]:
    """One line for everything in the files that is broken; nothing where all is well."""
    pages = read_pages(site)
    linked = {site / "index.html"}
    for path, page in pages.items():
        name = path.relative_to(site)
        for url in page.links:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            linked |= {target} - {path}
            if not target.is_file():
                yield f"{name} links to {url}, which does not exist"
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors | {""}:
                yield f"{name} links to {url}, which has no such anchor"
        yield from (f"{name} {each}" for each in wrong_requests(path, page.requests))
        yield from (f"{name} shows {text[:200]}" for text in page.left_over)
    yield from (f"nothing links to {path.relative_to(site)}" for path in set(pages) - linked)
    for style in site.rglob("*.css"):
        urls = IN_STYLE.findall(style.read_text("utf-8"))
        yield from (f"{style.relative_to(site)} {each}" for each in wrong_requests(style, urls))


def wrong_requests(path: Path, urls: list[str]) -> Iterator[str]:
    """Requests that leave the site, and those for files that it lacks."""
    for url in urls:
        parts = urlsplit(url)
        if parts.netloc or parts.scheme not in ("", "data"):
            yield f"requests {url}, which is not part of the site"
        elif parts.path and not parts.scheme and not (path.parent / unquote(parts.path)).is_file():
            yield f"requests {url}, which does not exist"


def problems_in_browser(site: Path, browser: str) -> Iterator[str]:
    """What a browser requests from other hosts, and formulas that it does not show."""
    for path, page in read_pages(site).items():
        if page.formulas or path == site / "index.html":
            yield from (f"{path.relative_to(site)} {each}" for each in opened(page, browser))


def opened(page: Page, browser: str) -> Iterator[str]:
    """The problems of one page in a browser."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        log = Path(folder) / "requests.json"
        options = ["--headless", "--no-sandbox", f"--user-data-dir={folder}", "--dump-dom"]
        shown = subprocess.run(
            [browser, *options, f"--log-net-log={log}", page.path.as_uri()],
            capture_output=True,
            check=True,
            text=True,
            timeout=120,
        ).stdout
        events = json.loads(log.read_text("utf-8"))["events"]
    for event in events:
        details = event.get("params", {})
        # The browser's own requests, for updates, have no origin.
        by_page = details.get("initiator", "not an origin") != "not an origin"
        if by_page and not details["url"].startswith(("file:", "data:")):
            yield f"requests {details['url']} in a browser"
    rendered = shown.count('class="katex"')
    if rendered != page.formulas or "katex-error" in shown:
        yield f"shows {rendered} of {page.formulas} formulas in a browser"


def installed_browser() -> str | None:
    """The path of a Chromium, or None."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


if __name__ == "__main__":
    site = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else SITE
    browser = installed_browser()
    found = [*problems(site), *(problems_in_browser(site, browser) if browser else ())]
    print("\n".join(found) if found else f"{site / 'index.html'}: no dead link, no request outside")
    if not browser:
        print(f"Formulas were not looked at in a browser: none of {', '.join(BROWSERS)} is here.")
    sys.exit(bool(found))
