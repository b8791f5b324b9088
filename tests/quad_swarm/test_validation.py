"""How a wrong value is told: in one line, with its name, also where it was given by position."""

import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
from pydantic import PositiveInt

from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.task.request_task import make_task
from quad_swarm.validation import Range, checked, checked_arguments, read_yaml, replaced, with_fields
from quad_swarm.world.presets import SwarmConfig, make_config


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


class Taker:
    @checked_arguments
    def take(self, number: int = 0) -> int:
        return number


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Inner((2, 1)), r"pair=(2, 1): it must be the lowest value first, then the highest."),
        (lambda: Inner(count=0), "count=0: it must be greater than 0."),
        (lambda: Inner(cuont=0), "Unknown Inner parameter 'cuont'; known: count, pair. Did you mean 'count'?"),
        (lambda: Outer(Inner(count=2), True), "flag=True goes with inner.count=1 alone."),
        (lambda: Taker().take(numbr=1), "Unknown argument 'numbr'; known: number. Did you mean 'number'?"),
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


@pytest.mark.parametrize("cls", [QuadrotorParams, SwarmConfig])
def test_a_checked_class_keeps_its_documentation(cls):
    assert ":param" in cls.__doc__


def test_values_come_in_their_types():
    assert function("3", {"a": "1e-3"}) == (3, {"a": 0.001}, {})
    assert replaced(Outer(), {"flag": "true", "inner": {"pair": ["0.5", 2]}}) == Outer(Inner((0.5, 2.0)), True)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10), ("0x10", 16), ("-3", -3), ("1e-3", 1e-3), (".5", 0.5), ("1.0e-05", 1e-5), ("-.inf", -math.inf),
        ("1:30", "1:30"), ("2001-01-01", "2001-01-01"), ("2001-99-99", "2001-99-99"), ("yes", "yes"), ("on", "on"),
        ("true", True), ("", None), ("[1, {a: x}]", [1, {"a": "x"}]), ("a: &a [1]\nb: *a", {"a": [1], "b": [1]}),
        ("<<: {a: 1}", {"<<": {"a": 1}}),
    ],
)  # fmt: skip
def test_yaml_holds_plain_values(text, value):
    found = read_yaml(text)
    assert found == value
    assert type(found) is type(value)


def _aliases(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join(9 * [f'*a{k - 1}'])}]" for k in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_aliases(9), "more than 10000 values"), ("&a [*a]", "more than 10000 values"), ("x" * 200_000, "characters"),
        ("[" * 9000, "nested too deeply"), ("[" * 102 + "]" * 102, "nested too deeply"),
        ("{a: " * 9000, "nested too deeply"), ("{a: 1, a: 2}", "'a' is given twice"),
        ("!!python/name:os.system", "constructor"), ("!!int 1:30", "1:30"), ("!!timestamp 1", "constructor"),
        ("!!binary x", "constructor"),
        ("[", "YAML: line 1, column 2: expected"), ("\0", "no valid YAML"), ("{[1]: 2}", "no valid YAML"),
    ],
)  # fmt: skip
def test_yaml_of_strangers_is_refused_in_one_line(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_yaml(text)
    assert "\n" not in str(caught.value)
    assert type(caught.value) is ValueError


@pytest.mark.parametrize("flag", [True, False, np.True_])
def test_truth_values_are_no_numbers(flag):
    for make in (lambda: QuadrotorParams(flag), lambda: QuadrotorParams(drag_x=flag)):
        with pytest.raises(ValueError, match=rf"='{bool(flag)}': it must be a valid number"):
            make()
    for changes in ({"substeps": flag}, {"space": {"heights": [flag, 2]}}, {"planner": {"max_tilt": flag}}):
        with pytest.raises(ValueError, match=rf"='{bool(flag)}': it must be a valid"):
            make_config("paper", changes)
    assert make_config("paper", continuous_collisions=flag).continuous_collisions is bool(flag)


def test_truth_values_are_no_numbers_among_arguments():
    for arguments in ({"memory": True}, {"max_steps": np.True_}, {"n_robots": True}):
        (name,) = arguments
        with pytest.raises(ValueError, match=f"{name}='True': it must be a valid"):
            make_task(**arguments)
    assert make_task(n_robots=2, end_at_arrival=True, max_steps=100).end_at_arrival


@dataclass(frozen=True)
class Options:
    size: PositiveInt = 1
    name: str = "x"


def test_fields_of_a_dataclass_become_arguments():
    @with_fields(Options)
    def described(first: int, options: Options, last: bool = False) -> tuple:
        """Return all."""
        return first, options, last

    assert described.__doc__ == "Return all."
    assert str(inspect.signature(described)).startswith("(first: int, size: ")
    assert described(1) == (1, Options(), False)
    assert described("2", "3", last="true") == (2, Options(3), True)
    assert described(first=2, name="y") == (2, Options(name="y"), False)
    with pytest.raises(ValueError, match=r"size=0: it must be greater than 0"):
        described(1, size=0)
    with pytest.raises(ValueError, match=r"Unknown argument 'sise'.*Did you mean 'size'"):
        described(1, sise=0)
    with pytest.raises(ValueError, match="first"):
        described(name="y")
