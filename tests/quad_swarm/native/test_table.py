"""The table of compiled functions is that of their sources: names, order, types, and what is written."""

import re
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.native import pairs, table
from quad_swarm.native.signature import Array, Signature
from quad_swarm.planner.rti import solver

NATIVE = Path(table.__file__).parent
SOURCES = {NATIVE / table.SOURCE: list(table.TABLE.values()), Path(solver.__file__).with_name("kernel.cpp"): None}
SHORT = {"std::int64_t": "Integer", "std::uint8_t": "Flag"}
IN_C = {
    np.dtype(np.float64): "double",
    np.dtype(np.float32): "float",
    np.dtype(np.int64): "Integer",
    np.dtype(np.bool_): "Flag",
}
IN_C[table.STATISTICS] = "Statistics"


def in_source(path: Path) -> dict[str, list[tuple[str, str]]]:
    """:return: type and name of each parameter of the exported functions"""
    text = re.sub(r"//.*", "", path.read_text(encoding="utf-8"))
    found = {}
    for name, parameters in re.findall(r"(?:EXPORT|extern \"C\"[^\n;{]*) void (\w+)\(([^)]*)\)\s*\{", text):
        parts = [re.fullmatch(r"(.*\S)\s*\b(\w+)", one.strip(), re.DOTALL) for one in parameters.split(",")]
        found[name] = [(SHORT.get(kind := part[1].replace(" *", "*"), kind), part[2]) for part in parts]
        found[name] = [(re.sub("|".join(SHORT), lambda one: SHORT[one[0]], kind), name_) for kind, name_ in found[name]]
    return found


def in_table(signature: Signature) -> list[tuple[str, str | None]]:
    """:return: the same of a signature, in which sizes have no names"""
    found: list[tuple[str, str | None]] = [("Integer", None)] * len(signature.sizes)
    for name, one in signature.parameters.items():
        if isinstance(one, Array):
            found.append((("const " if one.direction == "in" else "") + f"{IN_C[one.dtype]}*", name))
        else:
            found.append(({"int": "Integer", "real": "double"}[one], name))
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_the_table_is_that_of_the_source(path):
    functions = in_source(path)
    signatures = SOURCES[path] or [solver.SIGNATURE]
    assert set(functions) == {one.name for one in signatures}
    for signature in signatures:
        sizes = len(signature.sizes)
        mine, source = in_table(signature), functions[signature.name]
        assert [kind for kind, _ in mine] == [kind for kind, _ in source], signature.name
        assert [name for _, name in mine[sizes:]] == [name for _, name in source[sizes:]], signature.name


def test_the_record_of_statistics_is_that_of_the_source():
    text = (NATIVE / table.SOURCE).read_text(encoding="utf-8")
    fields = re.findall(
        r"(Integer|double|Flag) ([\w, ]+);", re.search(r"struct Statistics \{(.*?)\}", text, re.DOTALL)[1]
    )
    in_c = [(name, kind) for kind, names in fields for name in names.split(", ")]
    assert in_c == [(name, IN_C[table.STATISTICS[name]]) for name in table.STATISTICS.names]


def test_a_wrong_array_is_named():
    line = np.zeros((3, 4, 3))
    with pytest.raises(ValueError, match="age has type int32"):
        pairs.remember(line, np.zeros(3, dtype=np.int32), line[:, 0], 0.1)
    with pytest.raises(ValueError, match=r"remembered has shape \(3, 4, 2\); it must be \(3, N \+ 1, 3\)"):
        pairs.remember(line[..., :2], np.zeros(3, dtype=np.int64), line[:, 0], 0.1)
