"""The error for an unknown name."""

import pytest

from quad_swarm.errors import shown, unknown_name


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("radnom", "Unknown rule 'radnom'; known: full, none, random. Did you mean 'random'?"),
        ("xyz", "Unknown rule 'xyz'; known: full, none, random."),
        (5, "Unknown rule 5; known: full, none, random."),
        ([10**5000], "Unknown rule <list>; known: full, none, random."),
        (None, "Unknown rule None; known: full, none, random. Did you mean 'none'?"),
    ],
)
def test_names_what_exists_and_what_was_meant(value, message):
    assert str(unknown_name("rule", value, (name for name in ("random", "none", "full")))) == message


def test_any_value_is_shown_in_a_short_line():
    assert shown("a") == "'a'"
    assert shown(10**400) == f"1{'0' * 99} ... {'0' * 66}"
    assert shown([10**5000]) == "<list>"
    assert shown(10**5000) == "<int>"
