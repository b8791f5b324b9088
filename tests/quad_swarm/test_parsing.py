"""What a command of the package says about mistyped words."""

import pytest

from quad_swarm.parsing import Parser


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--polcy", "none"], "unrecognized arguments: --polcy none; did you mean '--policy'?\n"),
        (["--policy", "ful"], "; did you mean 'full'?\n"),
        (["--xyz"], "unrecognized arguments: --xyz\n"),
        (["--policy"], "argument --policy: expected one argument\n"),
    ],
)
def test_the_nearest_option_and_choice_are_named(words, told, capsys):
    parser = Parser("thing")
    parser.add_argument("--policy", choices=["full", "none"])
    with pytest.raises(SystemExit) as stopped:
        parser.parse_args(words)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.endswith(told)
