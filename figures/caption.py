"""The words around a picture: what it is of, where it is cut, what is held constant."""

from collections.abc import Sequence

from figures import style
from figures.cut import Cells


def titles(
    items: Sequence[tuple[str, Cells]], width: float, panel_width: float
) -> tuple[str, list[str]]:
    """Title of the figure and of each panel, in lines of `width` and `panel_width` points.

    The figure's title has what all panels share, a panel's title has its own.
    """
    parts = [part for _, part in items]
    names = {part.name for part in parts}
    common = shared([part.fixed for part in parts])
    head = [style.fold(parts[0].name, width)] if len(names) == 1 else []
    panels = []
    for title, part in items:
        own = [text for text in (*part.fixed, *_own(part, parts)) if text not in common]
        lines = [title, part.name if len(names) > 1 else ""]
        lines = [style.fold(line, panel_width) for line in lines if line]
        panels.append("\n".join([*lines, *([style.wrap(own, panel_width)] if own else [])]))
    head += [style.wrap(common, width)] if common else []
    return "\n".join(line for line in head if line), panels


def of_choices(head: str, part: Cells, width: float) -> str:
    """A title with the label of what is drawn below it, if that has no colour bar: choices."""
    return "\n".join([head, style.fold(part.label, width)]) if part.choices else head


def held(parts: Sequence[Cells], width: float) -> str:
    """What all panels hold constant, defaults included, in small lines of `width` points."""
    texts = shared([part.held for part in parts])
    return style.wrap(texts, width, style.SMALL_SIZE) if texts else ""


def shared(lists: Sequence[Sequence[str]]) -> list[str]:
    """The texts that are in every list, in order."""
    return [text for text in lists[0] if all(text in other for other in lists)]


def _own(part: Cells, parts: Sequence[Cells]) -> list[str]:
    common = shared([other.held for other in parts])
    return [text for text in part.held if text not in common]
