"""A view is the query of an address and back; a wrong address is one line."""

from dataclasses import replace
from urllib.parse import quote

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fic_jax import CHOICES, QUANTITIES
from sweeps.explore.live import SPACE, Live
from sweeps.explore.view import History, Range, ViewError, changed, parse

LIVE = Live()
START, DEFAULTS = LIVE.start, LIVE.defaults
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def places(draw):
    """A value of each name."""
    numbers = {name: draw(NUMBERS) for name in SPACE.numbers}
    return numbers | {name: draw(st.sampled_from(words)) for name, words in CHOICES.items()}


@st.composite
def views(draw):
    """Any view of the live explorer, sensible or not."""
    x, y = draw(st.permutations(sorted(QUANTITIES)))[:2]
    ends = st.builds(Range, NUMBERS, NUMBERS, st.sampled_from(["log", "lin"]))
    colours = draw(st.none() | st.tuples(NUMBERS, NUMBERS).filter(lambda pair: pair[0] < pair[1]))
    return replace(
        START,
        metric=draw(st.sampled_from(SPACE.metrics)),
        x=x,
        y=y,
        at=draw(places()),
        ranges={x: draw(ends), y: draw(ends)},
        colours=colours,
        cell=draw(st.none() | st.tuples(NUMBERS, NUMBERS)),
        pins=tuple(draw(st.lists(places(), max_size=2))),
    )


@settings(max_examples=100, deadline=None)
@given(views())
def test_an_address_holds_the_whole_view(view):
    start = replace(START, ranges={})  # nothing comes from the start
    assert parse(view.query(DEFAULTS), start, SPACE, DEFAULTS) == view


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["x", "y", "cell", "pin", "Td", "range.K0", "over"]) | st.text(),
            st.text(),
        )
    )
)
def test_any_address_is_a_view_or_one_line(pairs):
    query = "&".join(f"{quote(key)}={quote(value)}" for key, value in pairs)
    try:
        parse(query, START, SPACE, DEFAULTS)
    except ViewError as error:
        line = str(error)
        assert line.isprintable()
        assert len(line) < 1_500


@pytest.mark.parametrize(
    ("query", "wanted"),
    [
        ("Td=nan", "`Td` must be a finite number"),
        ("Td=1e999", "`Td` must be a finite number"),
        ("kenv=3", "did you mean `Kenv`"),
        ("metric=nmsee", "nmse"),
        ("contact=glued", "`contact` must be one of hard_stop, damped_rebound, welded"),
        ("x=K0&y=K0", "two different"),
        ("range.K0=log:1", "log:LOW:HIGH"),
        ("cell=1", "two values"),
        ("colours=2:1", "LOW:HIGH"),
        ("pin=&pin=&pin=&pin=", "at most 3 pins"),
        ("a" * 9_000, "at most 8,000"),
        ("&".join(f"Td={i}" for i in range(101)), "at most 100"),
    ],
)
def test_a_wrong_address_is_named(query, wanted):
    with pytest.raises(ViewError, match=wanted):
        parse(query, START, SPACE, DEFAULTS)


def test_what_an_address_does_not_name_is_as_at_the_start():
    view = parse("Td=7", START, SPACE, DEFAULTS)
    assert view == replace(START, at={**START.at, "Td": 7.0})


def test_undo_goes_back_view_by_view():
    one, two = (changed(START, "Td", text, SPACE) for text in ("1", "2"))
    history = History([START])
    for view in (one, one, two):
        history.settle(view)
    assert history.undo(two) == one
    assert history.undo(one) == START
    assert history.undo(START) == START


def test_undo_of_a_view_in_motion_returns_to_the_last_at_rest():
    history = History([START])
    assert history.undo(changed(START, "Td", "3", SPACE)) == START


def test_pins_hold_all_of_their_cell():
    view = replace(START, cell=(50.0, 20.0))
    view = view.pinned(view.place())
    moved = changed(view, "Td", "9", SPACE)
    (pin,) = moved.pins
    assert (pin["Td"], pin["Kenv"], pin["K0"]) == (5.0, 50.0, 20.0)
    assert len(view.pinned(view.place()).pins) == 1  # the same cell once
