"""Parser of the commands of this package, which names the nearest option for one that is mistyped."""

from __future__ import annotations

import argparse
import difflib
import re
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """Parser that keeps the line breaks of its texts, and suggests options and choices in its errors."""

    def __init__(self, prog: str, **kwargs: Any):
        super().__init__(prog, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        """Print the message with the nearest option or choice, and exit with the status 2."""
        if unknown := re.match(r"unrecognized arguments: (--?[\w-]+)", message):
            word, known = unknown[1], [option for action in self._actions for option in action.option_strings]
        elif chosen := re.match(r"argument .*: invalid choice: '(.*?)' \(choose from (.*)\)", message):
            word, known = chosen[1], re.findall(r"[\w-]+", chosen[2])
        else:
            super().error(message)
        nearest = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
        super().error(f"{message}; did you mean '{nearest[0]}'?" if nearest else message)
