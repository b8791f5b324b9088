"""The parsers of all commands, for the page `cli.md`."""

import importlib
from collections.abc import Callable
from functools import partial

from sb3_maddpg.cli import returns
from sb3_maddpg.cli.main import COMMANDS, build_parser
from sb3_maddpg.cli.offered import GROUPS
from sb3_maddpg.cli.parser import Parser
from sb3_maddpg.offers import offer_named


def parser_of(command: str) -> Parser:
    """
    :param command: name of a command
    :return: its parser; that of the swarm, if packages provide it
    """
    if command in GROUPS:
        return importlib.import_module(offer_named(GROUPS[command], "QuadSwarm-v0").module).make_parser()
    return build_parser()[1][command]


def shown(make: Callable[[], Parser]) -> Parser:
    """
    :param make: makes a parser
    :return: the parser, with each example as a paragraph, since the page has no blocks of code here
    """
    parser = make()
    title, colon, examples = (parser.epilog or "").partition(":\n")
    if colon:
        parser.epilog = "\n\n".join([f"{title}:", *map(str.strip, examples.splitlines())])
    return parser


# Functions by name, which is what the directive `argparse` takes
FUNCTIONS: dict[str, Callable[[], Parser]] = {name: partial(parser_of, name) for name in COMMANDS}
FUNCTIONS["evaluate_elsewhere"] = returns.make_parser
FUNCTIONS = {name: partial(shown, make) for name, make in FUNCTIONS.items()}
globals().update(FUNCTIONS)
