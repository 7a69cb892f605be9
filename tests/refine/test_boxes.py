"""Which boxes are halved: as plain Python does it, and so that a border is followed."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweeps.refine.boxes import Boxes, Measure
from sweeps.refine.rounds import _difference
from tests.refine import plain


def differs(low, high):
    return np.where(low < high, np.inf, 0.0)


def grown(shape, refined, levels, values, budget=10**9, measure=None):
    """The boxes, and the cells that were simulated, once nothing is left to halve."""
    boxes = Boxes(shape, refined, levels)
    known = np.zeros(values.size, bool)
    cells, exhausted = boxes.coarse(), False
    while cells.size:
        known[cells] = True
        if exhausted:
            break
        low = np.where(known, values.ravel(), np.inf)
        high = np.where(known, values.ravel(), -np.inf)
        proposal = boxes.propose([Measure(low, high, measure or differs)])
        part, cells = boxes.within(proposal, known, budget - int(known.sum()))
        boxes.halve(part)
        exhausted = len(part) < len(proposal)
    return boxes, known.reshape(shape)


def whole(shape):
    return tuple(slice(0, n) for n in shape)


@st.composite
def fields(draw):
    """A field of classes on a small grid: half spaces, balls and specks."""
    sides = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
    levels = draw(st.integers(1, 2 if len(sides) == 3 else 3))
    shape = tuple((n << levels) + 1 for n in sides)
    place = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    across = [-1, *[1] * len(sides)]
    centre, slope = (rng.uniform(size=len(sides)).reshape(across) for _ in range(2))
    values = (((place - centre) ** 2).sum(0) < rng.uniform(0, 0.5)).astype(int)
    values += 2 * ((place * slope).sum(0) < rng.uniform(0, 1))
    values ^= rng.uniform(size=shape) < draw(st.sampled_from([0.0, 0.02]))
    coarse = int(np.prod([n + 1 for n in sides]))
    budget = draw(st.one_of(st.just(10**9), st.integers(coarse, max(coarse, values.size))))
    return tuple(sides), levels, values, budget


@given(fields())
@settings(max_examples=60, deadline=None)
def test_the_arrays_agree_with_plain_python(field):
    sides, levels, values, budget = field
    boxes, known = grown(values.shape, tuple(range(len(sides))), levels, values, budget)
    cells, leaves = plain.refined(
        sides, levels, lambda inside: len({values[cell] for cell in inside}) > 1, budget
    )
    assert set(zip(*(i.tolist() for i in np.nonzero(known)), strict=True)) == cells
    assert known.sum() <= budget
    level = np.full(values.shape, -1)
    for one, corner in leaves:
        closed = tuple(slice(c, c + (1 << (levels - one)) + 1) for c in corner)
        level[closed] = np.maximum(level[closed], one)
    found, nearest = boxes.around(whole(values.shape))
    np.testing.assert_array_equal(found, level)
    assert known.ravel()[nearest].all()
    corners = {
        (one, tuple(c + (i << (levels - one)) for c, i in zip(corner, move, strict=True)))
        for one, corner in leaves
        for move in itertools.product((0, 1), repeat=len(sides))
    }
    for cell in np.ndindex(values.shape):
        source = tuple(map(int, np.unravel_index(nearest[cell], values.shape)))
        assert (level[cell], source) in corners
        far = max(abs(i - c) for i, c in zip(cell, source, strict=True))
        assert 2 * far <= 1 << (levels - level[cell])


@given(fields(), st.data())
@settings(max_examples=25, deadline=None)
def test_parts_of_the_grid_agree_with_the_whole(field, data):
    sides, levels, values, budget = field
    boxes, _ = grown(values.shape, tuple(range(len(sides))), levels, values, budget)
    ends = [
        sorted(data.draw(st.lists(st.integers(0, n), min_size=2, max_size=2, unique=True)))
        for n in values.shape
    ]
    part = tuple(slice(*end) for end in ends)
    for here, there in zip(boxes.around(part), boxes.around(whole(values.shape)), strict=True):
        np.testing.assert_array_equal(here, there[part])


@given(fields())
@settings(max_examples=25, deadline=None)
def test_other_dimensions_are_refined_each_by_itself(field):
    sides, levels, values, _ = field
    several = np.stack([values, values[..., ::-1], np.zeros_like(values)], axis=1)
    refined = tuple(0 if axis == 0 else axis + 1 for axis in range(len(sides)))
    boxes, known = grown(several.shape, refined, levels, several)
    for i in range(3):
        one, alone = grown(values.shape, tuple(range(len(sides))), levels, several[:, i])
        np.testing.assert_array_equal(known[:, i], alone)
        here = boxes.around(whole(several.shape))[0][:, i]
        np.testing.assert_array_equal(here, one.around(whole(values.shape))[0])


def edge(classes):
    """Cells with a neighbour of another class."""
    found = np.zeros(classes.shape, bool)
    for axis in range(classes.ndim):
        before = (slice(None),) * axis
        low, high = (*before, slice(0, -1)), (*before, slice(1, None))
        found[low] |= classes[low] != classes[high]
        found[high] |= classes[low] != classes[high]
    return found


@pytest.mark.parametrize("dims", [2, 3])
def test_a_border_that_the_coarse_grid_sees_is_found_whole(dims):
    """Each cell at the border is simulated: at its first point, and wherever it leads."""
    levels, sides = (5, 4) if dims == 2 else (3, 4)
    n = (sides << levels) + 1
    place = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * dims, indexing="ij"))
    radius = np.sqrt((place**2).sum(0)) + 0.05 * np.sin(7 * np.arctan2(place[0], place[1]))
    ball = (radius < 0.7).astype(int)
    _, known = grown(ball.shape, tuple(range(dims)), levels, ball)
    assert known[edge(ball)].all()
    assert known.mean() < (0.25 if dims == 2 else 0.7)


def test_a_border_is_followed_into_boxes_whose_corners_agree():
    """A finger, thinner than a coarse box, that leads from a seen region across many boxes."""
    levels, sides = 5, 8
    n = (sides << levels) + 1
    field = np.zeros((n, n), int)
    field[:, : n // 8] = 1
    row = np.round(n / 2 + 5 + 8 * np.sin(np.arange(n) / 20)).astype(int)
    for column in range(n - 20):
        field[row[column] : row[column] + 3, column] = 1
    _, known = grown(field.shape, (0, 1), levels, field)
    assert known[edge(field)].all()


def test_what_no_known_cell_shows_is_missed():
    """An island between coarse cells: no method that samples finds it but by luck."""
    field = np.zeros((33, 33), int)
    field[2:4, 2:4] = 1
    _, known = grown(field.shape, (0, 1), 3, field)
    assert known.sum() == 25


def test_a_budget_is_spent_on_coarse_boxes_first_and_on_what_differs_most():
    values = np.zeros(33)
    values[9:], values[21:] = 1.0, 10.0
    measure = _difference("nmse", {"nmse": 0.1}, {})
    boxes, known = grown(values.shape, (0,), 3, values, 6, measure)
    assert known.sum() == 6
    # 16 to 24 differs by 9 and is halved; 8 to 16 differs by 1, and the budget has ended
    assert np.flatnonzero(known).tolist() == [0, 8, 16, 20, 24, 32]
    assert boxes.leaves.max() == 1
    every, _ = grown(values.shape, (0,), 3, values, 33, measure)
    assert every.leaves.max() == 3


@pytest.mark.parametrize(
    ("absolute", "relative", "low", "high", "halved"),
    [
        ({"nmse": 0.1}, {}, 1.0, 1.05, False),
        ({"nmse": 0.1}, {}, 1.0, 1.2, True),
        ({}, {"nmse": 0.1}, 1.0, 1.05, False),
        ({}, {"nmse": 0.1}, 1.0, 1.2, True),
        ({}, {"nmse": 0.1}, -1.2, -1.0, True),
        ({}, {"nmse": 0.1}, 1e-14, 9e-13, False),  # below the floor of its trust, 1e-12
        ({"convergence_time": 1.0}, {}, 3.0, np.inf, True),
        ({}, {"convergence_time": 0.5}, 3.0, np.inf, True),
        ({}, {"convergence_time": 0.5}, np.inf, np.inf, False),
        ({}, {"convergence_time": 0.5}, np.inf, -np.inf, False),  # nothing is known
    ],
)
def test_tolerances(absolute, relative, low, high, halved):
    (name,) = {*absolute, *relative}
    found = _difference(name, absolute, relative)(np.array([low]), np.array([high]))
    assert (found > 1).tolist() == [halved]
