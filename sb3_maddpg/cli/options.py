"""What all commands share: their name and the options that each of them looks at."""

import argparse

PROG = "sb3-maddpg"


def common_options() -> argparse.ArgumentParser:
    """The options that all commands look at; what they call reads the rest."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="maddpg")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    return parser
