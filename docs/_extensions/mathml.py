"""Equations as MathML, which browsers show without a script or a network.

docutils translates LaTeX to MathML. The font, _static/math.woff, has 90 kB: without one for
mathematics, as on most Linux desktops, braces do not stretch. MathJax has 2 MB of scripts.
"""

from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.writers.html5 import HTML5Translator


def _mathml(latex: str, block: bool) -> str:
    text = tex2mathml(latex, as_block=block)
    text = text.replace("munder>", "msub>")  # where docutils puts the index of an accented letter
    return text.replace('<mo stretchy="false">|', '<mo stretchy="false" lspace="0" rspace="0">|')


def _inline(page: HTML5Translator, node: nodes.math) -> None:
    page.body.append(_mathml(node.astext(), block=False))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
    page.body.append(page.starttag(node, "div", CLASS="math"))
    page.body.append(f"{_mathml(node.astext(), block=True)}{number}</div>")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
