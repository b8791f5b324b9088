"""Parsing of values on the command line and in recipes without running code."""

from __future__ import annotations

import ast
import importlib
import itertools
import math
from collections import Counter
from typing import Any

import yaml

from sb3_maddpg.utils import shown, told

WORDS = {"true": True, "false": False, "null": None, "none": None}
NOT_FINITE = ("nan", "inf", "infinity")
# The classes that recipes of rl_zoo3 name: activation functions and optimizers
CLASSES = {
    **dict.fromkeys(("nn", "th.nn", "torch.nn"), ("torch.nn", "Module")),
    **dict.fromkeys(("th.optim", "torch.optim"), ("torch.optim", "Optimizer")),
}
_LITERALS = (ast.Expression, ast.Constant, ast.List, ast.Tuple, ast.Dict, ast.Load)

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
        return _finite(ast.literal_eval(_Literals().visit(ast.parse(text.strip(), mode="eval"))))
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
        return _complete(_finite(yaml.load(text, BoundedLoader)))
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


class _Literals(ast.NodeTransformer):
    """
    Makes a tree one for ``ast.literal_eval``: calls of dict, list and tuple become displays, and classes of PyTorch
    become constants. It refuses all else.
    """

    def visit(self, node: ast.AST) -> Any:
        found = super().visit(node)
        if not isinstance(found, _LITERALS):
            raise ValueError(
                f"{_text(node)} is not evaluated: write numbers, quoted text, lists, dicts or classes of torch.nn"
            )
        return found

    def visit_Constant(self, node: ast.Constant) -> Any:
        return node if isinstance(node.value, (bool, int, float, str, type(None))) else ast.Pass()

    def visit_UnaryOp(self, node: ast.UnaryOp) -> Any:
        match node:
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=ast.Constant(value=int() | float() as value)):
                return ast.Constant(-value if isinstance(node.op, ast.USub) else value)
        return node

    def visit_Dict(self, node: ast.Dict) -> Any:
        if None in node.keys:  # {**more}
            return ast.Pass()
        node = self.generic_visit(node)  # type: ignore[assignment]
        for key in node.keys:
            try:
                hash(ast.literal_eval(key))  # type: ignore[arg-type]
            except TypeError:
                raise ValueError(f"{_text(key)} cannot be the key of a dict") from None
        return node

    def visit_Call(self, node: ast.Call) -> Any:
        match node:
            case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(one.arg for one in keywords):
                return ast.Dict(
                    [ast.Constant(one.arg) for one in keywords], [self.visit(one.value) for one in keywords]
                )
            case ast.Call(func=ast.Name(id="list" | "tuple" as name), args=[argument], keywords=[]):
                elements = self.visit(argument)
                if not isinstance(elements, (ast.List, ast.Tuple)):
                    raise ValueError(f"{_text(node)} needs a list or a tuple: write {name}([...])")
                return (ast.List if name == "list" else ast.Tuple)(elements.elts, ast.Load())
        return node

    def visit_Name(self, node: ast.Name) -> Any:
        return ast.Constant(_rmsprop()) if node.id == "RMSpropTFLike" else node

    def visit_Attribute(self, node: ast.Attribute) -> Any:
        if (name := ast.unparse(node.value)) not in CLASSES:
            return node
        package, base = CLASSES[name]
        module = importlib.import_module(package)
        found = getattr(module, node.attr, None)
        if not (isinstance(found, type) and issubclass(found, getattr(module, base))):
            raise ValueError(f"there is no class {node.attr} in {package}")
        return ast.Constant(found)  # type: ignore[arg-type]


def _text(node: Any) -> str:
    return ast.unparse(node)[:200]


def _rmsprop() -> Any:
    from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

    return RMSpropTFLike


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


def _complete(value: Any) -> Any:
    """:return: the value, if no colon in it lacks its blank, which YAML reads as a part of the key"""
    if isinstance(value, dict):
        for key, one in value.items():
            if one is None and isinstance(key, str) and ":" in key:
                raise ValueError(f"{shown(key)} needs a blank after the colon: {key.replace(':', ': ', 1)}")
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _complete(one)
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
        if value.__name__ == "RMSpropTFLike":
            return value.__name__
        return f"th.{'optim' if value.__module__.startswith('torch.optim') else 'nn'}.{value.__name__}"
    return repr(value)


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

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        names = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if twice := [name for name, count in names.items() if count > 1 and name != "<<"]:
            where = "" if self.name.startswith("<") else f"{self.name}: "  # text of a command line has no name
            raise Refused(f"{where}{shown(twice[0])} is given twice")
        return node

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
