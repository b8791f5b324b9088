"""Parsers of the command line: a short and a full help, and the nearest known word for one that is mistyped."""

from __future__ import annotations

import argparse
import re
import shutil
from collections.abc import Callable, Collection
from typing import Any, NoReturn

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import did_you_mean


class UsageError(InvalidArgumentError):
    """
    The words of a command are wrong.

    :param prog: the command
    :param message: what is wrong
    """

    def __init__(self, prog: str, message: str):
        super().__init__(message)
        self.prog = prog


class Parser(argparse.ArgumentParser):
    """
    Parser whose ``--help`` shows the frequent options and whose ``--help-all`` shows all of them.

    :param prog: the command
    :param further: returns text at the end of ``--help-all``
    :param add_help: whether to add these two options
    """

    def __init__(self, prog: str, further: Callable[[], str] | None = None, add_help: bool = True, **kwargs: Any):
        super().__init__(prog, add_help=False, formatter_class=_Formatter, **kwargs)
        self.further = further
        self._rare: list[argparse.Action] = []
        if add_help:
            self.add_argument("-h", "--help", action=_Help, help="show the frequent options")
            self.add_argument("--help-all", action=_Help, help="show all options, and what is installed")

    def rare(self, *names: str, **kwargs: Any) -> None:
        """Add an option that only ``--help-all`` shows, see ``add_argument``."""
        self._rare.append(self.add_argument(*names, **kwargs))

    def frequent(self, names: Collection[str]) -> None:
        """
        Show options in ``--help`` after all.

        :param names: names of rare options
        """
        self._rare = [action for action in self._rare if not set(names) & set(action.option_strings)]

    def error(self, message: str) -> NoReturn:
        """:raises UsageError: with the message and the nearest option or choice"""
        if unknown := re.match(r"unrecognized arguments: (--?[\w-]+)", message):
            options = [option for action in self._actions for option in action.option_strings]
            message += did_you_mean(unknown[1], options).replace(" D", "; d")
        elif chosen := re.match(r"argument .*: invalid choice: '(.*?)' \(choose from (.*)\)", message):
            message += did_you_mean(chosen[1], re.findall(r"[\w-]+", chosen[2]), cutoff=0.6).replace(" D", "; d")
        raise UsageError(self.prog, message)

    def format_some(self, whole: bool) -> str:
        """
        :param whole: whether to show the rare options too
        :return: the help
        """
        hidden = {} if whole else {action: action.help for action in self._rare}
        for action in hidden:
            action.help = argparse.SUPPRESS
        try:
            text = self.format_help()
        finally:
            for action, shown in hidden.items():
                action.help = shown
        return f"{text}\n{self.further()}\n" if whole and self.further is not None else text


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str):
        super().__init__(prog, max_help_position=32, width=min(shutil.get_terminal_size((100, 24)).columns, 120) - 2)


class _Help(argparse.Action):
    def __init__(self, option_strings: list[str], dest: str, help: str | None = None):
        super().__init__(option_strings, argparse.SUPPRESS, default=argparse.SUPPRESS, nargs=0, help=help)

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        print(parser.format_some(option_string == "--help-all"), end="")
        parser.exit()
