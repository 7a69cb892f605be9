"""Refinement in plain Python, one box at a time: `sweeps.refine` must agree with it.

A cell is a tuple of indices on the finest grid, a box a level and its first corner.
"""

import itertools


def refined(sides, levels, differ, budget):
    """The simulated cells, and the boxes that are not halved.

    `sides`: boxes of level 0 along each axis; `differ(cells)`: whether a box with these known cells
    is halved. Rounds, neighbours and the budget are as docs/refine.md says.
    """
    axes = range(len(sides))
    coarse = [range(0, (n << levels) + 1, 1 << levels) for n in sides]
    known = set(itertools.product(*coarse))
    boxes = {(0, tuple(i << levels for i in at)) for at in itertools.product(*map(range, sides))}
    halved = set()
    while True:
        all_boxes = boxes | halved
        differing = [
            box for box in all_boxes if box[0] < levels and differ(inside(box, known, levels))
        ]
        wanted = []
        for level, corner in differing:
            step = 1 << (levels - level)
            for move in itertools.product((-step, 0, step), repeat=len(sides)):
                beside = (level, tuple(corner[a] + move[a] for a in axes))
                if beside in boxes and beside not in wanted:
                    wanted.append(beside)
        wanted.sort(key=lambda box: (box[0], box not in differing, box[1]))
        for box in wanted:
            new = set(parts(box, levels)) - known
            if len(known | new) > budget:
                return known, boxes
            known = known | new
            boxes.remove(box)
            halved.add(box)
            level, corner = box
            half = 1 << (levels - level - 1)
            for move in itertools.product((0, half), repeat=len(sides)):
                boxes.add((level + 1, tuple(corner[a] + move[a] for a in axes)))
        if not wanted:
            return known, boxes


def parts(box, levels):
    """The corners of the parts of a box."""
    level, corner = box
    half = 1 << (levels - level - 1)
    return itertools.product(*((c, c + half, c + 2 * half) for c in corner))


def inside(box, known, levels):
    """The known cells in a box and on its faces."""
    level, corner = box
    step = 1 << (levels - level)
    along = [range(c, c + step + 1) for c in corner]
    return [cell for cell in itertools.product(*along) if cell in known]
