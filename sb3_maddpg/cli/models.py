"""``sb3-maddpg pretrained``, ``convert`` and ``publish``: files of models."""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, cast

from sb3_maddpg.cli.algorithms import team_algorithm
from sb3_maddpg.cli.options import check_writable
from sb3_maddpg.cli.runs import model_path
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.hub.pretrained import pretrained_folder, pretrained_models

if TYPE_CHECKING:
    from sb3_maddpg.files.saving import Lean


def pretrained(args: argparse.Namespace, words: list[str]) -> int:
    """
    List the pretrained models, or show or copy one.

    :param args: options of ``pretrained``
    :param words: unused
    :return: exit status
    """
    if args.name is None:
        if args.out:
            raise InvalidArgumentError("--out needs the NAME of a model.")
        for name in pretrained_models():
            print(f"{name:20} {_headline(pretrained_folder(name) / 'README.md')}")
        return 0
    folder = pretrained_folder(args.name)
    if args.out:
        copy = args.out / args.name
        shutil.copytree(folder, copy)
        print(f"copied to {copy}")
        return 0
    if (readme := folder / "README.md").is_file():
        print(readme.read_text())
    print(f"Files: {folder}")
    return 0


def convert(args: argparse.Namespace, words: list[str]) -> int:
    """
    Convert a model's file.

    :param args: options of ``convert``
    :param words: unused
    :return: exit status
    """
    check_writable(args.new)
    team_algorithm(args.algo).load(args.old, device="cpu").save(args.new, lean=args.lean)
    print(f"wrote {args.new}")
    return 0


def publish(args: argparse.Namespace, words: list[str]) -> int:
    """
    Upload a model, or write what would be uploaded.

    :param args: options of ``publish``
    :param words: unused
    :return: exit status
    """
    from sb3_maddpg.hub import model_card

    path = Path(model_path(args.model, args.algo, args.env))
    model, lean = team_algorithm(args.algo).load(path, device="cpu"), None if args.whole else "critic"
    if args.out is not None:
        model_card.write_model_folder(model, args.out, args.repository, path.parent, cast("Lean | None", lean))
        print(f"wrote {args.out}")
    else:
        print(model_card.publish(model, args.repository, path.parent, cast("Lean | None", lean), args.private))
    return 0


def _headline(readme: Path) -> str:
    """:return: the first sentence of a model's README without Markdown; a colon also ends it"""
    text = " ".join(readme.read_text().split("\n\n")[0].split()) if readme.is_file() else ""
    return re.split(r"(?<=[.:])\s", text.lstrip("# ").replace("`", ""), maxsplit=1)[0].rstrip(".:")
