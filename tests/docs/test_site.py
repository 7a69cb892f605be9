"""The documentation builds without a warning, and its pages work without a network."""

import re
import subprocess
import sys
from collections import defaultdict
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tests.docs.blocks import ROOT

# What a browser loads by itself, and where its address stands.
LOADED = {"img": "src", "script": "src", "link": "href", "source": "src", "iframe": "src"}
NOT_LOADED = {"canonical", "next", "prev", "index", "search", "author", "genindex"}  # rel of links


class Page(HTMLParser):
    """What a page loads, where it leads, what can be led to, and pictures without words."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.leads_to: list[str] = []
        self.names: set[str] = set()
        self.wordless: list[str] = []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = defaultdict(str, {name: value or "" for name, value in attributes})
        self.names |= {given["id"], given["name"]}
        if tag == "a" and given["href"]:
            self.leads_to.append(given["href"])
        if tag in LOADED and given[LOADED[tag]] and given["rel"] not in NOT_LOADED:
            self.loads.append(given[LOADED[tag]])
        if tag == "img" and not given["alt"]:
            self.wordless.append(given["src"])
        drawn = tag == "svg" and given["role"] == "img"
        if drawn and not (given["aria-labelledby"] or given["aria-label"]):
            self.wordless.append(tag)


def test_the_documentation_builds_and_works_without_a_network(tmp_path):
    """One test: the build takes most of its time."""
    site = tmp_path / "site"
    build = [sys.executable, "-m", "sphinx", "-W", "-n", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*build, "-d", tmp_path / "doctrees", ROOT / "docs", site],
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stderr
    pages = {path: Page(path) for path in site.rglob("*.html")}
    assert len(pages) > 20
    wrong = []
    for path, page in pages.items():
        wrong += [f"{path.name}: {image} has no words" for image in page.wordless]
        for address in page.loads:
            url = urlsplit(address)
            if url.scheme or url.netloc or not (path.parent / unquote(url.path)).is_file():
                wrong.append(f"{path.name} loads {address}")
        for address in page.leads_to:
            url = urlsplit(address)
            if url.scheme or url.netloc:
                continue  # to the web, for who has a network
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            there = pages.get(target)
            if not target.is_file() or (
                there and url.fragment and unquote(url.fragment) not in there.names
            ):
                wrong.append(f"{path.name} leads to {address}")
    assert not wrong, "\n".join(wrong)
    for style in site.rglob("*.css"):
        loaded = re.findall(
            r"(?:url\(|@import)\s*['\"]?(?!data:)([^'\")]+)", style.read_text("utf-8")
        )
        assert all((style.parent / url).is_file() for url in loaded), (style.name, loaded)
