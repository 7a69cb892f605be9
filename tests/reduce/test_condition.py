"""A condition: what it means, and that nothing but a condition is evaluated."""

import numpy as np
import pytest

from sweeps.spec.condition import ConditionError, holds, names

VALUES = {"a": np.array([1.0, 3.0, np.inf, np.nan]), "b": np.array([0.0, 0.0, 2.0, 2.0]), "c": 2.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a < 2", [1, 0, 0, 0]),
        ("not a < 2", [0, 1, 1, 1]),
        ("1 < a <= 3 and b == 0", [0, 1, 0, 0]),
        ("a < 2 or b >= c", [1, 0, 1, 1]),
        ("abs(a - c) > 1 / b", [0, 0, 1, 0]),
        ("-a * 2 + 1 < -1", [0, 1, 1, 0]),
        ("c != 2", [0]),
    ],
)
def test_a_condition_means_what_python_means(text, expected):
    np.testing.assert_array_equal(np.atleast_1d(holds(text, VALUES)), np.array(expected, bool))


def test_names_are_those_of_variables():
    assert sorted(names("abs(nmse) < 1 and (Td > nmse or Td == 0)")) == ["Td", "nmse"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a",
        "a <",
        "a < 1; b < 1",
        "a and b < 1",
        "(a < 1) < 2",
        "(a < 1) + 1 < 2",
        "a.real < 1",
        "a[0] < 1",
        "a < True",
        "a < 'x'",
        "a ** 2 < 1",
        "a in b",
        "a < 1 if b < 1 else c < 1",
        "(lambda: 1)() < 1",
        "__import__('os').getpid() < 1",
        "abs(a, b) < 1",
        "a < 1" + "0" * 400,
        "a < " + "(" * 500 + "1" + ")" * 500,
        "a < 1" + " and a < 1" * 200,
        "a < 1\x00",
    ],
)
def test_all_else_is_refused_in_one_line(text):
    with pytest.raises(ConditionError) as refused:
        names(text)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("a = 1", "`==`, not with `=`"),
        ("a < 1 && b == 0", "`and`, not with `&&`"),
        ("(a < 1) & (b == 0)", "`and`, not with `&`"),
        ("a < 1 AND b == 0", "`and`, not with `AND`"),
        ("a < 1 || b >= 0", "`or`, not with `||`"),
        ("(a <= 1) | (b != 0)", "`or`, not with `|`"),
        ("!(a < 1)", "`not`, not with `!`"),
        ("~(a < 1)", "`not`, not with `~`"),
        ("a <> 1", "`!=`, not with `<>`"),
        ("a ≤ 1", "`<=`, not with `≤`"),
        ("a ^ 2 < 1", "a product, as `nmse * nmse`, not with `^`"),
        ("a ** 2 < 1", "a product, as `nmse * nmse`, not with `**`"),
    ],
)
def test_what_other_languages_write_has_its_own_advice(text, advice):
    with pytest.raises(ConditionError) as refused:
        names(text)
    assert str(refused.value) == f"written with {advice}"
