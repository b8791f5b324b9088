"""Protection that keeps commands of rl_zoo3 and Stable-Baselines3 from running code in files."""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, cast

import rl_zoo3.exp_manager
import rl_zoo3.utils
import yaml
from stable_baselines3.common import base_class, off_policy_algorithm

from sb3_maddpg.cli.literals import parse_literal
from sb3_maddpg.model_files import refuse_pickled, refuse_pickled_file, trusted
from sb3_maddpg.normalization import SafeVecNormalize


class RunLoader(yaml.SafeLoader):
    """YAML loader for run folders, which accepts plain values and the Python types that rl_zoo3 writes."""

    def get_single_data(self) -> Any:
        try:
            return super().get_single_data()
        except RecursionError:
            raise ValueError(f"{self.name} is nested too deeply to belong to a run.") from None


def _ordered_dict(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> dict[Any, Any]:
    """Read an OrderedDict, which rl_zoo3 writes with a list of pairs as its argument."""
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


def _tuple(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


def _refuse(loader: yaml.SafeLoader, node: yaml.Node) -> None:
    raise ValueError(
        f"{node.start_mark.name} holds a value that is not plain ({node.tag}). Reading it may run any code: if you "
        "trust its author, pass --trust."
    )


RunLoader.add_constructor(cast(Any, None), _refuse)
for _tag, _read in (("object/apply:collections.OrderedDict", _ordered_dict), ("tuple", _tuple)):
    RunLoader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", cast(Any, _read))


@contextmanager
def no_code_from_files() -> Iterator[None]:
    """
    Replace rl_zoo3's unsafe loaders by safe ones, unless the user trusts the files. The originals call functions named
    in YAML, evaluate text, and unpickle models, replay buffers and statistics.
    """
    load_model = base_class.load_from_zip_file

    def load_plain_model(path: Any, load_data: bool = True, custom_objects: Any = None, **kwargs: Any) -> Any:
        refuse_pickled(path, custom_objects or {})
        return load_model(path, load_data, custom_objects, **kwargs)

    def load_plain_file(path: Any, *args: Any, **kwargs: Any) -> Any:
        refuse_pickled_file(path)

    zoo = (rl_zoo3.utils, rl_zoo3.exp_manager)
    changes: list[tuple[Any, str, Any]] = [(module, "VecNormalize", SafeVecNormalize) for module in zoo]
    if not trusted(None):
        changes += [
            (yaml, "UnsafeLoader", RunLoader),
            (base_class, "load_from_zip_file", load_plain_model),
            (off_policy_algorithm, "load_from_pkl", load_plain_file),
            *((module, "eval", parse_literal) for module in zoo),
        ]
    with ExitStack() as stack:
        for change in changes:
            stack.enter_context(_replaced(*change))
        yield


@contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute of a module, or shadow the builtin of that name in it."""
    before = getattr(module, name, None)
    setattr(module, name, value)
    try:
        yield
    finally:
        if before is None and hasattr(builtins, name):
            delattr(module, name)
        else:
            setattr(module, name, before)
