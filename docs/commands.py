"""The parsers of all commands, for the page `cli.md`."""

import importlib
from collections.abc import Callable
from functools import partial

from sb3_maddpg.cli.main import COMMANDS, build_parser
from sb3_maddpg.cli.parser import Parser

MODULES = {
    "evaluate": "quad_swarm.evaluation.command",
    "replay": "quad_swarm.figures.replay",
    "identify": "quad_swarm.evaluation.identification",
    "export": "quad_swarm.evaluation.export",
    "fly": "quad_swarm.evaluation.fly",
}


def parser_of(command: str) -> Parser:
    """
    :param command: name of a command
    :return: its parser; that of the package that provides it, if it parses its own words
    """
    if command in MODULES:
        return importlib.import_module(MODULES[command]).make_parser()
    return build_parser()[1][command]


# Functions by name, which is what the directive `argparse` takes
FUNCTIONS: dict[str, Callable[[], Parser]] = {name: partial(parser_of, name) for name in COMMANDS}
globals().update(FUNCTIONS)
