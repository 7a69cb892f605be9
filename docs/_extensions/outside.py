"""Pages whose text lies elsewhere in the repository, and links to such files.

A page `{include} ../CONTRIBUTING.md` gets that file's text, with links as this folder sees them. A
link to a file that is no page becomes a download.
"""

import os
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent.parent
_INCLUDE = re.compile(r"```\{include\} (\.\./\S+)\n```\s*")
_LINK = re.compile(r"(?<=\]\()(?![a-z+]+:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")
_ANCHOR = re.compile(r'^<a id="(\w+)"></a>$', re.MULTILINE)


def _included() -> dict[Path, str]:
    """A file elsewhere -> the page that has its text."""
    found = ((page, _INCLUDE.fullmatch(page.read_text("utf-8"))) for page in DOCS.glob("*.md"))
    return {(DOCS / match[1]).resolve(): page.name for page, match in found if match}


def _read(_app: Any, page: str, source: list[str]) -> None:
    folder = DOCS
    if match := _INCLUDE.fullmatch(source[0]):
        file = (DOCS / match[1]).resolve()
        source[0], folder = file.read_text("utf-8"), file.parent
    pages = _included()

    def seen_from_here(link: re.Match[str]) -> str:
        file = (folder / link[1]).resolve()
        path = pages.get(file) or os.path.relpath(file, DOCS)
        scheme = "path:" if path.startswith("../") else ""  # no page: a download
        return f"{scheme}{path}{link[2] or ''}"

    # anchors of the report: Sphinx doesn't know those of HTML
    source[0] = _ANCHOR.sub(r"(\1)=", _LINK.sub(seen_from_here, source[0]))


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
