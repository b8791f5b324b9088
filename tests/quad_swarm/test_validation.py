"""How a wrong value is told: in one line, with its name, also where it was given by position."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest
from pydantic import PositiveInt

from quad_swarm.validation import Range, checked, checked_arguments, replaced


@checked
@dataclass(frozen=True)
class Inner:
    pair: Range = (0.0, 1.0)
    count: PositiveInt = 1


@checked
@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    flag: bool = False

    def __post_init__(self):
        if self.flag and self.inner.count > 1:
            raise ValueError("flag=True goes with inner.count=1 alone")


@checked_arguments
def function(number: PositiveInt, text: str | Mapping[str, float] = "", **others: int) -> tuple:
    return number, text, others


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Inner((2, 1)), r"pair=(2, 1): it must be the lowest value first, then the highest."),
        (lambda: Inner(count=0), "count=0: it must be greater than 0."),
        (lambda: Inner(cuont=0), "Unknown Inner parameter 'cuont'; known: count, pair. Did you mean 'count'?"),
        (lambda: Outer(Inner(count=2), True), "flag=True goes with inner.count=1 alone."),
        (lambda: replaced(Outer(), {"inner": {"count": 0}}), "inner.count=0: it must be greater than 0."),
        (lambda: replaced(Inner(), {"count": 0}, "there"), "there.count=0: it must be greater than 0."),
        (lambda: function(0), "number=0: it must be greater than 0."),
        (lambda: Inner((0, 1e5)), "pair.1=100000.0: it must be less than or equal to 10000."),
        (lambda: function(-(10**400)), f"number=-1{'0' * 98} ... {'0' * 66}: it must be greater than 0."),
        (lambda: function(1, 5), "text=5: it must be a valid string or it must be a valid mapping."),
        (
            lambda: function(1, others="x"),
            "others='x': it must be a valid integer, unable to parse string as an integer.",
        ),
    ],
)
def test_one_line_says_where_and_what(call, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        call()


def test_values_come_in_their_types():
    assert function("3", {"a": "1e-3"}) == (3, {"a": 0.001}, {})
    assert replaced(Outer(), {"flag": "true", "inner": {"pair": ["0.5", 2]}}) == Outer(Inner((0.5, 2.0)), True)
