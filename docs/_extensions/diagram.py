"""A drawing inside the page, so that it has the page's colours, light or dark."""

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective


class Diagram(SphinxDirective):
    """`{diagram} FILE.svg`, with a caption below it; the SVG has a title for who can't see it."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """The figure as HTML."""
        name, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(name)
        drawing, caption = Path(path).read_text("utf-8"), " ".join(self.content)
        figure = f'<figure class="diagram">{drawing}<figcaption>{caption}</figcaption></figure>'
        return [nodes.raw("", figure, format="html")]


def setup(app: Any) -> dict[str, bool]:  # noqa: D103  Sphinx's name
    app.add_directive("diagram", Diagram)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
