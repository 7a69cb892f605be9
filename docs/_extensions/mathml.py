"""Equations as MathML, which browsers show without a script or a font from the network.

docutils translates LaTeX to MathML. MathJax would add 10 MB of scripts to the pages, or load them.
"""

from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.writers.html5 import HTML5Translator


def _inline(page: HTML5Translator, node: nodes.math) -> None:
    page.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
    page.body.append(page.starttag(node, "div", CLASS="math"))
    page.body.append(f"{tex2mathml(node.astext(), as_block=True)}{number}</div>")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
