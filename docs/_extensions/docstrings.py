"""Docstrings as they are: paragraphs as text, indented equations and lists as they are laid out."""

import re
from typing import Any


def _laid_out(
    _app: Any, _kind: str, _name: str, _object: Any, _options: Any, lines: list[str]
) -> None:
    """A paragraph with indented lines becomes a literal block; reST would join or refuse them."""
    text = []
    for paragraph in re.split(r"\n\s*\n", "\n".join(lines).strip()):
        if re.search(r"^\s", paragraph, re.MULTILINE):
            text += ["::", "", *(f"    {line}" for line in paragraph.splitlines()), ""]
        else:
            text += [*paragraph.splitlines(), ""]
    lines[:] = text


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    app.connect("autodoc-process-docstring", _laid_out)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
