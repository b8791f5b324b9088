"""Parsing of values on the command line and in recipes without running code."""

import argparse
import ast
import itertools
import math
from typing import Any

import torch
import yaml
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_maddpg.utils import shown, told

WORDS = {"true": True, "false": False, "null": None, "none": None}
NOT_FINITE = ("nan", "inf", "infinity")
SEQUENCES = {"list": list, "tuple": tuple}
# Modules of the classes that recipes of rl_zoo3 name: activation functions and optimizers
CLASSES = {
    **{name: (torch.nn, torch.nn.Module) for name in ("nn", "th.nn", "torch.nn")},
    **{name: (torch.optim, torch.optim.Optimizer) for name in ("th.optim", "torch.optim")},
}

# Maximum number of values in a YAML file after replacing its aliases by what they stand for
_MOST_VALUES = 100_000
_DEEPEST = 100  # brackets around a value


def parse_literal(text: str) -> Any:
    """
    Parse a Python literal: numbers, quoted text, lists, tuples, dicts (also as ``dict(a=1)``), and classes of
    ``torch.nn`` and ``torch.optim``, such as ``nn.ReLU``. Nothing is evaluated.

    :param text: e.g. "dict(net_arch=[64, 64], activation_fn=nn.ReLU)"
    :return: the value
    :raises ValueError: if the text is anything else, or contains a number that is not finite
    """
    try:
        return _finite(_value(ast.parse(text.strip(), mode="eval").body))
    except SyntaxError as error:
        raise ValueError(f"{shown(text)} is not valid Python: {error.msg}") from error
    except (RecursionError, MemoryError):  # Python's parser raises either
        raise ValueError(f"{shown(text)} is nested too deeply") from None


def parse_value(text: str) -> Any:
    """
    Parse a value of the command line: a Python literal (``parse_literal``), ``true``, ``false`` or ``null``, a YAML
    list or dict such as ``{preset: dense}``, or a word such as ``state+memory``.

    :param text: the value without its key
    :return: the value
    :raises ValueError: if the text is an expression that would have to be evaluated, or a number that is not finite
    """
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    try:
        return parse_literal(_finite(text))
    except ValueError as error:
        if _is_word(text):
            return _finite(text)
        if text[0] not in "[{":
            raise error
    try:
        return _finite(yaml.load(text, BoundedLoader))
    except (yaml.YAMLError, RecursionError):
        raise ValueError(f"{shown(text)} is neither a list nor a dict, in Python or in YAML") from None


def _is_word(text: str) -> bool:
    """:return: whether the text needs no quotes, because it has neither brackets nor arithmetic"""
    if set(text) & set("()[]{}"):
        return False
    try:
        tree = ast.parse(text, mode="eval")
    except SyntaxError:
        return True
    except (RecursionError, MemoryError):
        return False
    # Arithmetic has only constants, as has an overflowing number
    return any(isinstance(node, ast.Name) for node in ast.walk(tree))


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() | None as value):
            return value
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=ast.Constant(value=int() | float() as value)):
            return -value if isinstance(node.op, ast.USub) else value
        case ast.List(elts=elements):
            return [_value(element) for element in elements]
        case ast.Tuple(elts=elements):
            return tuple(_value(element) for element in elements)
        case ast.Dict(keys=keys, values=values) if None not in keys:
            return {_key(key): _value(value) for key, value in zip(keys, values, strict=True)}
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(one.arg for one in keywords):
            return {one.arg: _value(one.value) for one in keywords}
        case ast.Call(func=ast.Name(id="list" | "tuple" as name), args=[argument], keywords=[]):
            if isinstance(elements := _value(argument), (list, tuple)):
                return SEQUENCES[name](elements)
            raise ValueError(f"{name}({shown(elements)}) needs a list or a tuple: write {name}([...])")
        case ast.Name(id="RMSpropTFLike"):
            return RMSpropTFLike
        case ast.Attribute(value=module, attr=name) if ast.unparse(module) in CLASSES:
            package, base = CLASSES[ast.unparse(module)]
            found = getattr(package, name, None)
            if isinstance(found, type) and issubclass(found, base):
                return found
            raise ValueError(f"there is no class {name} in {package.__name__}")
    raise ValueError(
        f"{ast.unparse(node)} is not evaluated: write numbers, quoted text, lists, dicts or classes of torch.nn"
    )


def _key(node: ast.expr | None) -> Any:
    key = _value(node)  # type: ignore[arg-type]
    try:
        hash(key)
    except TypeError:
        raise ValueError(f"{shown(key)} cannot be the key of a dict") from None
    return key


def _finite(value: Any) -> Any:
    not_finite = isinstance(value, float) and not math.isfinite(value)
    if not_finite or (isinstance(value, str) and value.lower().lstrip("+-.") in NOT_FINITE):
        raise ValueError(f"{str(value)[:50]} is not a finite number")
    if isinstance(value, dict):
        contents = [*value, *value.values()]
    else:
        contents = list(value) if isinstance(value, (list, tuple)) else []
    for one in contents:
        _finite(one)
    return value


def format_literal(value: Any) -> str:
    """
    Format a value as text for ``parse_literal``.

    :param value: a literal, which may contain classes of ``torch.nn``
    :return: the text
    """
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {format_literal(one)}" for key, one in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(format_literal, value)) + "]"
    if isinstance(value, type):
        module = "optim" if issubclass(value, torch.optim.Optimizer) else "nn"
        return value.__name__ if value is RMSpropTFLike else f"th.{module}.{value.__name__}"
    return repr(value)


class StoreValues(argparse.Action):
    """
    Action that stores ``key:value key:value`` as a dict, for rl_zoo3's options. Unlike rl_zoo3's own action, it
    evaluates nothing, see ``parse_value``. If the option is repeated, its pairs come together.
    """

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        before = getattr(namespace, self.dest, None)
        pairs: dict[str, Any] = {} if before is None or before is self.default else dict(before)
        try:
            for word in values:
                key, _, value = word.partition(":")
                if not key or not value:
                    raise ValueError(f"'{word}' has no value")
                if key in pairs:
                    raise ValueError(f"'{key}' is given twice")
                pairs[key] = parse_value(value)
        except ValueError as error:
            raise ValueError(f"{option_string} {shown(' '.join(values))}: {error}. Write key:value.") from error
        setattr(namespace, self.dest, pairs)


class Refused(ValueError):
    """Text that is valid YAML, but is not accepted; the message says why."""


class BoundedLoader(yaml.SafeLoader):
    """YAML loader that refuses text whose aliases stand for more values than fit into memory, and all wrong values."""

    def get_single_data(self) -> Any:
        try:
            return super().get_single_data()
        except (AttributeError, TypeError, LookupError, ArithmeticError) as error:  # such as `!!timestamp 1`
            raise yaml.constructor.ConstructorError(
                problem=f"a value is not what its tag says ({told(error)})"
            ) from error
        except ValueError as error:  # such as 2001-99-99
            if isinstance(error, (UnicodeError, Refused)):
                raise
            raise yaml.constructor.ConstructorError(problem=f"a value is not what it seems ({told(error)})") from error

    def fetch_flow_collection_start(self, token: type[yaml.Token]) -> None:
        if self.flow_level > _DEEPEST:  # the time of the scanner grows with the square
            raise RecursionError
        super().fetch_flow_collection_start(token)

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > _MOST_VALUES:
            raise Refused(f"{self.name} holds more than {_MOST_VALUES} values: shorten it, and use fewer aliases.")
        return node


def _count(node: yaml.Node, counted: dict[int, float]) -> float:
    """:return: the number of values in a node, infinite for a node inside itself"""
    if id(node) not in counted:
        counted[id(node)] = math.inf
        pairs = isinstance(node, yaml.MappingNode)
        parts = itertools.chain.from_iterable(node.value) if pairs else node.value
        counted[id(node)] = 1 + sum(_count(one, counted) for one in parts if isinstance(one, yaml.Node))
    return counted[id(node)]
