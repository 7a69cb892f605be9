"""Sphinx's settings. `make docs` writes the pages to docs/_build/html; nothing needs a network."""

import sys
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path[:0] = [str(FOLDER.parent), str(FOLDER / "_extensions")]

from fic_jax import __version__  # noqa: E402  the path first

project = "fic_jax"
version = release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "diagram",
    "docstrings",
    "mathml",
    "outside",
    "reference",
]
exclude_patterns = ["_build", "_extensions"]
myst_enable_extensions = ["dollarmath", "amsmath", "attrs_inline"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # the report begins some parts one level deeper
default_role = "code"  # docstrings write `name`
pygments_style, pygments_dark_style = "a11y-high-contrast-light", "a11y-high-contrast-dark"
copybutton_prompt_text, copybutton_line_continuation_character = "$ ", "\\"
copybutton_only_copy_prompt_lines = True

autodoc_typehints = "none"  # the docstrings name types, shapes and units
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True  # `Model()` and not all its choices
add_module_names = False

html_theme = "furo"
html_title = f"fic_jax {version}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_search_summary = False  # fetched, which a file:// page may not
html_copy_source = html_show_sphinx = html_show_copyright = False
