"""The words around a picture: what it is of, where it is cut, what is held constant."""

from collections.abc import Sequence

from figures import style
from figures.cut import Cells


def titles(
    rows: Sequence[Sequence[tuple[str, Cells]]], width: float, panel_width: float
) -> tuple[str, list[list[str]], list[str]]:
    """Title of the figure, of each panel and of each row, in lines of so many points.

    The figure's title has what all panels share. What the panels of a column share stands above the
    first of them, what those of a row share beside it, and the rest above its own panel.
    """
    parts = [part for row in rows for _, part in row]
    names = {part.name for part in parts}
    common = shared([part.fixed for part in parts])
    head = [style.fold(parts[0].name, width)] if len(names) == 1 else []
    head += [style.wrap(common, width)] if common else []
    own = [[_own(part, parts, common) for _, part in row] for row in rows]
    beside = [shared(row) for row in own] if len(rows) > 1 else [[]]
    above = [shared(column) for column in zip(*own, strict=True)]
    panels = []
    for i, row in enumerate(rows):
        titled = []
        for j, (title, part) in enumerate(row):
            rest = [t for t in own[i][j] if t not in beside[i] and (i == 0 or t not in above[j])]
            lines = [title, part.name if len(names) > 1 else ""]
            lines = [style.fold(line, panel_width) for line in lines if line]
            titled.append("\n".join([*lines, *([style.wrap(rest, panel_width)] if rest else [])]))
        panels.append(titled)
    return "\n".join(line for line in head if line), panels, [", ".join(row) for row in beside]


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


def _own(part: Cells, parts: Sequence[Cells], common: Sequence[str]) -> list[str]:
    """What a panel fixes or holds that not all panels share."""
    held_by_all = shared([other.held for other in parts])
    fixed = [text for text in part.fixed if text not in common]
    return fixed + [text for text in part.held if text not in held_by_all]
