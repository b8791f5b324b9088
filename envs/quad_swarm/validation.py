"""Validation of settings and arguments by pydantic, with error messages of one line.

Text is converted to the value it stands for ("false", "1e-3", "10"), as it comes from YAML and command lines, which
`read_yaml` reads.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
import pydantic.dataclasses
import yaml
from pydantic_core import ArgsKwargs

from quad_swarm.errors import shown, unknown_name

T = TypeVar("T")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

# Similarity from which on a name is taken for a mistyped one of another level
_CLOSE = 0.75
_STRICT = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False)


# Limit of lengths and coordinates (m), far beyond any flight and small enough for precise squares
LARGEST_LENGTH = 1e4
LARGEST_ANGLE = 1e4  # rad
Length = Annotated[float, pydantic.Field(ge=0, le=LARGEST_LENGTH)]
PositiveLength = Annotated[float, pydantic.Field(gt=0, le=LARGEST_LENGTH)]
Coordinate = Annotated[float, pydantic.Field(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH)]


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError("it must be the lowest value first, then the highest")
    return pair


Count = Annotated[int, pydantic.Field(ge=0, le=200)]
Range = Annotated[tuple[Coordinate, Coordinate], pydantic.AfterValidator(_ascending)]


def points(name: str, values: Any, count: int) -> np.ndarray:
    """Convert points to an array, (count, 3) (m).

    :raises ValueError: if the points have another shape, are not numbers, or are farther away than `LARGEST_LENGTH`
    """
    array = _numbers(values, (count, 3), LARGEST_LENGTH)
    if array is None:
        raise ValueError(
            f"{name} must be {count} finite points, shape ({count}, 3), within {LARGEST_LENGTH:.0f} m; got "
            f"{shown(values)}."
        )
    return array


def vectors(name: str, values: Any, count: int) -> np.ndarray:
    """Convert velocities to an array, (count, 3) (m/s).

    :raises ValueError: if they have another shape, are not numbers, or are larger than `LARGEST_LENGTH`
    """
    array = _numbers(values, (count, 3), LARGEST_LENGTH)
    if array is None:
        raise ValueError(
            f"{name} must be {count} finite vectors, shape ({count}, 3) (m/s), or None; got {shown(values)}."
        )
    return array


def angles(name: str, values: Any, count: int) -> np.ndarray:
    """Convert angles to an array, (count,) (rad).

    :raises ValueError: if the angles have another shape, are not numbers, or are larger than `LARGEST_ANGLE`
    """
    array = _numbers(values, (count,), LARGEST_ANGLE)
    if array is None:
        raise ValueError(
            f"{name} must be {count} finite angles, shape ({count},) (rad), up to {LARGEST_ANGLE:.0f}; got "
            f"{shown(values)}."
        )
    return array


def _numbers(values: Any, shape: tuple[int, ...], most: float) -> np.ndarray | None:
    """Convert numbers to an array, None if they have another shape, are no numbers, or larger than allowed."""
    try:
        array = np.asarray(values, dtype=float)
        valid = (
            not np.ma.is_masked(values)
            and not np.iscomplexobj(values)
            and array.shape == shape
            and bool((np.abs(array) <= most).all())
        )
    except (TypeError, ValueError, OverflowError):
        valid = False
    return array if valid else None


def checked(cls: type[T]) -> type[T]:
    """Decorate a frozen dataclass so that its fields are converted to their types and checked against their bounds.

    Nested dataclasses may be mappings. Truth values are no numbers. Invalid values raise a `ValueError` with one line.
    """
    plain = [field.name for field in dataclasses.fields(cls) if "bool" not in str(field.type)]  # type: ignore[arg-type]
    documentation = cls.__doc__

    def unflagged(values: Any) -> Any:
        if isinstance(values, ArgsKwargs):
            named = {
                name: _unflagged(value) if name in plain else value for name, value in (values.kwargs or {}).items()
            }
            names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
            rest = zip(names, values.args, strict=False)
            given = [_unflagged(value) if name in plain else value for name, value in rest]
            return ArgsKwargs((*given, *values.args[len(names) :]), named)
        if isinstance(values, Mapping):
            return {name: _unflagged(value) if name in plain else value for name, value in values.items()}
        return values

    cls._unflagged = pydantic.model_validator(mode="before")(staticmethod(unflagged))  # type: ignore[attr-defined]
    strict = pydantic.dataclasses.dataclass(frozen=True, config=_STRICT)(cls)
    construct = strict.__init__

    @functools.wraps(construct)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            construct(self, *args, **kwargs)
        except pydantic.ValidationError as error:
            raise explained(error, cls) from None

    strict.__init__ = init  # type: ignore[method-assign]
    strict.__doc__ = documentation  # which pydantic leaves out
    return strict  # type: ignore[return-value]


def _is_plain(annotation: Any) -> bool:
    """Return whether an argument is a number or a text, and true and false are neither."""
    return "bool" not in str(annotation) and any(one in str(annotation) for one in ("int", "Int", "float", "str"))


def _unflagged(value: Any) -> Any:
    """Return a value with texts instead of true and false, which would count as the numbers 1 and 0."""
    if isinstance(value, (bool, np.bool_)):
        return str(value)
    if isinstance(value, (list, tuple)) and any(isinstance(one, (bool, np.bool_)) for one in value):
        return [_unflagged(one) for one in value]
    return value


def checked_arguments(function: F) -> F:
    """Decorate a function so that its arguments are converted and checked like the fields of `checked`."""

    @functools.cache  # created at the first call to keep the import fast
    def call() -> Callable[..., Any]:
        return pydantic.validate_call(config=pydantic.ConfigDict(allow_inf_nan=False))(function)

    plain = {name for name, one in inspect.signature(function).parameters.items() if _is_plain(one.annotation)}

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        kwargs = {name: _unflagged(value) if name in plain else value for name, value in kwargs.items()}
        try:
            return call()(*args, **kwargs)
        except pydantic.ValidationError as error:
            raise explained(error, function) from None

    return wrapper  # type: ignore[return-value]


def with_fields(cls: type[Any]) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Decorate a function with a parameter ``options``, so that it takes the fields of a dataclass instead: by the same
    names, in the same order and with the same defaults, converted and checked like those of `checked_arguments`.

    :param cls: the dataclass
    """
    types = get_type_hints(cls, include_extras=True)
    fields = [
        inspect.Parameter(
            field.name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=field.default, annotation=types[field.name]
        )
        for field in dataclasses.fields(cls)
    ]

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        parameters: list[inspect.Parameter] = []
        for one in inspect.signature(function, eval_str=True).parameters.values():
            parameters += fields if one.name == "options" else [one]

        @functools.wraps(function)
        def flat(*args: Any, **kwargs: Any) -> R:
            given = signature.bind(*args, **kwargs).arguments
            options = cls(**{one.name: given.pop(one.name) for one in fields if one.name in given})
            return function(**given, options=options)

        signature = inspect.Signature(parameters)
        flat.__signature__ = signature  # type: ignore[attr-defined]
        flat.__annotations__ = {one.name: one.annotation for one in parameters if one.annotation is not one.empty}
        return checked_arguments(flat)

    return decorate


def replaced(config: T, changes: Mapping[str, Any], *path: str) -> T:
    """Replace fields of a `checked` dataclass. Mappings replace fields of nested dataclasses.

    :param config: the dataclass
    :param changes: field name -> new value
    :param path: path of the dataclass in the user's arguments, for error messages
    :return: the new dataclass
    :raises ValueError: if a field is unknown or a value is invalid; the message names its path
    """
    validator = type(config).__pydantic_validator__  # type: ignore[attr-defined]
    try:
        return validator.validate_python(_values(config, changes))
    except pydantic.ValidationError as error:
        raise explained(error, type(config), *path) from None


def _values(config: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    for name, value in changes.items():
        nested = isinstance(value, Mapping) and dataclasses.is_dataclass(values.get(name))
        values[name] = _values(values[name], value) if nested else value
    return values


# Limits of what `read_yaml` reads
MOST_CHARACTERS, _MOST_VALUES, _DEEPEST = 100_000, 10_000, 100


class _PlainLoader(yaml.SafeLoader):
    """YAML loader with the plain values of YAML 1.2 only: no dates, and "010", "1:30" and "yes" are no surprises."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}  # type: ignore[misc]  # filled below
    yaml_constructors: ClassVar[dict[Any, Any]] = {}

    def fetch_flow_collection_start(self, token: type[yaml.Token]) -> None:
        if self.flow_level > _DEEPEST:  # the time of the scanner grows with the square
            raise RecursionError
        super().fetch_flow_collection_start(token)

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > _MOST_VALUES:
            raise ValueError(f"more than {_MOST_VALUES} values")
        return node

    def whole(self, node: yaml.ScalarNode) -> int:
        """Construct an integer."""
        text = self.construct_scalar(node)
        return int(text, 0 if text[:2] in ("0x", "0o") else 10)

    def number(self, node: yaml.ScalarNode) -> float:
        """Construct a number."""
        return float(self.construct_scalar(node).lower().replace(".inf", "inf").replace(".nan", "nan"))

    def mapping(self, node: yaml.MappingNode) -> dict[Any, Any]:
        """Construct a mapping, in which each name occurs once."""
        pairs = [tuple(self.construct_object(one, deep=True) for one in pair) for pair in node.value]
        names = [name for name, _ in pairs]
        if len(set(names)) < len(names):
            raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
        return dict(pairs)


for _tag, _pattern, _construct in (
    ("null", r"~|null|Null|NULL|", yaml.SafeLoader.construct_yaml_null),
    ("bool", r"true|True|TRUE|false|False|FALSE", yaml.SafeLoader.construct_yaml_bool),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", _PlainLoader.whole),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        _PlainLoader.number,
    ),
    ("str", None, yaml.SafeLoader.construct_yaml_str),
    ("seq", None, lambda loader, node: loader.construct_sequence(node, deep=True)),
    ("map", None, _PlainLoader.mapping),
):  # the first pattern that matches counts
    if _pattern is not None:
        _PlainLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), None)
    _PlainLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _construct)
_PlainLoader.add_constructor(None, yaml.SafeLoader.construct_undefined)  # type: ignore[type-var]


def _count(node: yaml.Node, counted: dict[int, float]) -> float:
    """Return the number of values in a node, infinite for a node inside itself."""
    if id(node) not in counted:
        counted[id(node)] = math.inf
        pairs = isinstance(node, yaml.MappingNode)
        parts = itertools.chain.from_iterable(node.value) if pairs else node.value
        counted[id(node)] = 1 + sum(_count(one, counted) for one in parts if isinstance(one, yaml.Node))
    return counted[id(node)]


def read_yaml(text: str) -> Any:
    """Read values from text that may come from strangers, in bounded time and memory.

    Plain values are those of YAML 1.2: "010" is 10, and "1:30", "yes" and dates are text.

    :raises ValueError: if it is not YAML, too long, nested too deeply, or has a name twice; the message has one line
    """
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"more than {MOST_CHARACTERS} characters")
    try:
        return yaml.load(text, _PlainLoader)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (yaml.YAMLError, TypeError, KeyError, AttributeError, OverflowError) as error:
        told, mark = getattr(error, "problem", None) or str(error), getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ValueError(f"no valid YAML: {where}{' '.join(told.split())}") from None


def read_assignments(option: str, assignments: Iterable[str]) -> dict[str, Any]:
    """Convert ``["noise.wind=1", "memory=0.3"]`` to ``{"noise": {"wind": 1}, "memory": 0.3}``.

    :param option: where they were given, for error messages
    :param assignments: names and values, ``NAME=VALUE``
    :raises ValueError: if one is no assignment, or a name is given twice
    """
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ValueError(f"{option} {assignment!r}: write NAME=VALUE, for example planner.separation=0.63.")
        *parents, leaf = name.split(".")
        place = values
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                raise ValueError(f"{option} {assignment!r}: {parent!r} already has a plain value.")
        if leaf in place:
            raise ValueError(
                f"{option} {assignment!r}: {name!r} is given twice, before as {shown(place[leaf])}: leave one out."
            )
        try:
            place[leaf] = read_yaml(value)
        except ValueError as error:
            raise ValueError(
                f"{option} {shown(assignment)}: {shown(value)} is not valid YAML ({shown(str(error))}); quote text."
            ) from None
    return values


def explained(error: pydantic.ValidationError, owner: Any, *path: str) -> ValueError:
    """Convert a validation error to one line that names the argument, its value and what is allowed.

    :param error: pydantic's error
    :param owner: the dataclass or function that was called
    :param path: path of the owner in the user's arguments
    """
    unknown = ("unexpected_keyword_argument", "unexpected_positional_argument")
    # A mistyped name first, since what it was to be is missing too
    errors = sorted(error.errors(include_url=False), key=lambda each: each["type"] not in unknown)
    place, value = errors[0]["loc"], errors[0]["input"]
    if errors[0]["type"] in unknown:
        *parents, name = map(str, place)
        where = ".".join((*path, *parents))
        if ":" in name and value is None:
            return ValueError(f"{shown(name)} needs a blank after the colon: {name.replace(':', ': ', 1)}")
        kind = f"{where or owner.__name__} parameter" if isinstance(owner, type) else "argument"
        if isinstance(owner, type) and not parents and (deeper := _deeper(owner, name)):
            return ValueError(f"Unknown {kind} {shown(name)}: did you mean {' or '.join(deeper)}?")
        return unknown_name(kind, name, [one for one in _names(owner, parents) if one != "self"])
    if "str" in place:  # in a union, each member reports an error under the name of its type
        place = place[: place.index("str")]
        errors = [each for each in errors if each["loc"][: len(place)] == place]
    else:
        errors = errors[:1]
    if place and isinstance(place[0], int):  # a positional argument
        place = (_names(owner)[place[0]], *place[1:])
    problem = " or ".join(dict.fromkeys(_readable(each["msg"]) for each in errors))
    if errors[0]["type"] == "tuple_type" and (entries := _entries(owner, place)):
        problem = f"it must be a list of {entries}"
        problem += f", as in {[value, value]}" if entries == 2 and type(value) in (int, float) else ""
    name = ".".join((*path, *(str(part) for part in place)))
    if errors[0]["type"] == "value_error" and not isinstance(value, (tuple, list)):
        return ValueError(
            problem if problem.endswith(("?", ".")) else f"{problem}."
        )  # from `__post_init__`, which names the conflicting fields
    if errors[0]["type"] == "missing":
        if isinstance(place[-1], str):
            return ValueError(f"{name} is missing in {shown(value)}.")
        name, problem = name.rpartition(".")[0], "it has too few entries"
        problem += f": it must have {entries}" if (entries := _entries(owner, place[:-1])) else ""
    return ValueError(f"{name}={shown(value)}: {problem}.")


def _readable(message: str) -> str:
    message = message.removeprefix("Value error, ").replace("Input should", "it must", 1)
    message = message.replace("a valid tuple", "a list, [...]")
    message = re.sub(r"Tuple should have (at \w+ \d+) items? after validation", r"it must have \1 entries", message)
    message = message.replace("dictionary", "mapping").replace(" or an instance of ", ", not a plain value, or a ")
    return re.sub(r"\ba (?=[AEIOU][a-z])", "an ", message)


def _names(owner: Any, path: Sequence[str] = ()) -> list[str]:
    """Return the names of a function's parameters, or of the fields of the dataclass at ``path`` in a dataclass."""
    if not dataclasses.is_dataclass(owner):
        return list(inspect.signature(owner).parameters)
    for name in path:
        if not name.isdigit():  # an entry of a list
            owner = _dataclass_in(get_type_hints(owner)[name])
    return [field.name for field in dataclasses.fields(owner)]


def _entries(owner: Any, place: Sequence[Any]) -> int | None:
    """Return how many entries a list has at ``place`` in a dataclass or in a function's arguments, None for any
    number."""
    annotation = owner
    for part in place:
        if isinstance(part, str):
            within = annotation if annotation is owner else _dataclass_in(annotation)
            annotation = get_type_hints(within).get(part) if within is not None else None
    for one in (annotation, *get_args(annotation)):
        if get_origin(one) is tuple and Ellipsis not in get_args(one):
            return len(get_args(one))
    return None


def _deeper(owner: Any, name: str) -> list[str]:
    """Return where a name is a field of the dataclasses that the fields of one hold."""
    held = {field: _dataclass_in(annotation) for field, annotation in get_type_hints(owner).items()}
    near = difflib.get_close_matches(name, _names(owner), 1, _CLOSE)
    return [
        f"{field}.{found}"
        for field, one in held.items()
        if one is not None
        for found in difflib.get_close_matches(name, _names(one), 1, 1.0 if near else _CLOSE)
    ]


def _dataclass_in(annotation: Any) -> Any:
    """Return the dataclass that a field holds, as in ``tuple[Obstacle, ...]``."""
    if dataclasses.is_dataclass(annotation):
        return annotation
    return next((found for one in get_args(annotation) if (found := _dataclass_in(one))), None)
