"""Parsers: short and full help, and what they say about mistyped words."""

import argparse

import pytest

from sb3_maddpg.cli.parser import Parser, UsageError


@pytest.fixture
def parser() -> Parser:
    parser = Parser("thing", further=lambda: "what there is")
    parser.add_argument("--policy", choices=["full", "none"], help="often")
    parser.rare("--seed", help="seldom")
    return parser


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--polcy", "none"], "unrecognized arguments: --polcy none; did you mean '--policy'?"),
        (["--policy", "ful"], "; did you mean 'full'?"),
        (["--xyz"], "unrecognized arguments: --xyz"),
    ],
)
def test_the_nearest_option_and_choice_are_named(parser, words, message):
    with pytest.raises(UsageError) as refused:
        parser.parse_args(words)
    assert str(refused.value).endswith(message)
    assert refused.value.prog == "thing"


def test_other_parsers_stay_as_they_are(parser, capsys):
    with pytest.raises(SystemExit):
        argparse.ArgumentParser().parse_args(["--policy"])
    assert "did you mean" not in capsys.readouterr().err


def test_rare_options_are_in_the_full_help_only(parser, capsys):
    for option, shown in (("--help", ["often"]), ("-h", ["often"]), ("--help-all", ["often", "seldom", "what there"])):
        with pytest.raises(SystemExit) as stopped:
            parser.parse_args([option])
        assert stopped.value.code == 0
        printed = capsys.readouterr().out
        assert [text for text in ("often", "seldom", "what there") if text in printed] == shown
    assert parser.parse_args(["--seed", "1"]).seed == "1"
    parser.frequent({"--seed"})
    assert "seldom" in parser.format_some(whole=False)


def test_without_help_it_can_be_parsed_further():
    parser = Parser("thing", add_help=False)
    assert parser.parse_known_args(["--help"])[1] == ["--help"]
