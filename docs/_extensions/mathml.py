"""Equations as MathML, which browsers show without a script or a network.

docutils translates LaTeX to MathML. The font, _static/math.woff, has 90 kB: without one for
mathematics, as on most Linux desktops, braces do not stretch. MathJax has 2 MB of scripts.
"""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.writers.html5 import HTML5Translator

# docutils sets the index of an accented letter below it
_INDEX_BELOW = re.compile(
    r"<munderover>\s*(.*?)\s*\n\s*(\S.*?)\s*(<mo.*?</mo>)\s*</munderover>", re.DOTALL
)
_BAR = re.compile(r"<mo( class=\"mathopen\")?( stretchy=\"false\")?>\|")


def _mathml(latex: str, block: bool) -> str:
    text = tex2mathml(latex, as_block=block)
    text = _INDEX_BELOW.sub(r'<msub><mover accent="true">\1\3</mover>\2</msub>', text)
    return _BAR.sub('<mo stretchy="false" lspace="0" rspace="0">|', text)


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
