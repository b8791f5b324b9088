"""Protection that keeps commands of rl_zoo3 and Stable-Baselines3 from running code in files."""

from __future__ import annotations

import builtins
import itertools
import math
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

# Maximum number of values in a YAML file after replacing its aliases by what they stand for
_MOST_VALUES = 100_000


class BoundedLoader(yaml.SafeLoader):
    """YAML loader that refuses files whose aliases stand for more values than fit into memory."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > _MOST_VALUES:
            raise ValueError(f"{self.name} holds more than {_MOST_VALUES} values: shorten it, and use fewer aliases.")
        return node


def _count(node: yaml.Node, counted: dict[int, float]) -> float:
    """:return: the number of values in a node, infinite for a node inside itself"""
    if id(node) not in counted:
        counted[id(node)] = math.inf
        pairs = isinstance(node, yaml.MappingNode)
        parts = itertools.chain.from_iterable(node.value) if pairs else node.value
        counted[id(node)] = 1 + sum(_count(one, counted) for one in parts if isinstance(one, yaml.Node))
    return counted[id(node)]


class RunLoader(BoundedLoader):
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
