"""The error for an unknown name."""

import pytest

from quad_swarm.errors import unknown_name


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("radnom", "Unknown rule 'radnom'; known: full, none, random. Did you mean 'random'?"),
        ("xyz", "Unknown rule 'xyz'; known: full, none, random."),
        (5, "Unknown rule 5; known: full, none, random."),
        (None, "Unknown rule None; known: full, none, random. Did you mean 'none'?"),
    ],
)
def test_names_what_exists_and_what_was_meant(value, message):
    assert str(unknown_name("rule", value, (name for name in ("random", "none", "full")))) == message
