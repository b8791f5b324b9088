"""Signatures of compiled functions: what is passed, what is refused, and what comes back."""

import ctypes
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from quad_swarm.native import build, table
from quad_swarm.native.signature import Compiled, Signature

# Adds `more` and the weight of its row, if there are weights, to each number, and counts the rows in place
CODE = """
extern "C" void add_all(long long n_rows, long long n, double more, const double* numbers, const double* weights,
                        long long* counted, double* sums, unsigned char* large) {
  for (long long row = 0; row < n_rows; row++) {
    const double all = more + (weights ? weights[row] : 0);
    for (long long k = 0; k < n; k++) sums[row * n + k] = numbers[row * (n + 1) + k] + all;
    if (large) large[row] = sums[row * n] > 10;
    counted[0]++;
  }
}
"""


class Added(NamedTuple):
    sums: np.ndarray
    large: np.ndarray


SIGNATURE = Signature(
    "add_all",
    "R K",
    more="real",
    numbers="*R K+1 f8",
    weights="*R f8 optional",
    counted="1 i8 changed",
    sums="*R K f8 out",
    large="*R bool out optional",
    result=Added,
)


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("library")
    source, path = folder / "add.cpp", folder / "add.so"
    source.write_text(CODE)
    subprocess.run([*build.compiler(), "-shared", "-fPIC", str(source), "-o", str(path)], check=True)
    return ctypes.CDLL(str(path))


@pytest.fixture
def add(library):
    return SIGNATURE.of(library)


def arguments(**changes) -> dict:
    given = {"more": 1.0, "numbers": np.arange(24.0).reshape(2, 3, 4), "weights": None}
    return {**given, "counted": np.zeros(1, dtype=np.int64), "large": True, **changes}


@pytest.mark.parametrize("weights", [None, np.arange(6.0).reshape(2, 3)])
def test_letters_are_bound_and_results_allocated(add, weights):
    given = arguments(weights=weights)
    for calls in (1, 2):  # the second time the shapes are known
        found = add(**given)
        expected = given["numbers"][..., :3] + 1 + (0 if weights is None else weights[..., None])
        assert np.array_equal(found.sums, expected)
        assert np.array_equal(found.large, expected[..., 0] > 10)
        assert given["counted"] == [6 * calls]
    assert add(**arguments(large=False)).large is None


def test_what_is_read_may_lie_anyhow(add):
    for numbers in (np.asfortranarray(arguments()["numbers"]), np.arange(48.0).reshape(2, 3, 8)[..., ::2]):
        numbers.setflags(write=False)
        for _ in range(2):
            assert np.array_equal(add(**arguments(numbers=numbers)).sums, numbers[..., :3] + 1)
    assert add(**arguments(numbers=np.zeros((0, 4)))).sums.shape == (0, 3)
    assert add(**arguments(numbers=np.zeros(4))).sums.shape == (3,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"numbers": np.zeros((2, 3, 4), dtype=int)}, "numbers has type int64; it must be an array of float64"),
        ({"numbers": [[0.0]]}, "numbers has type list"),
        ({"numbers": None}, "numbers has type NoneType"),
        ({"numbers": np.array(0.0)}, r"numbers has shape \(\); it must be \(\.\.\., K \+ 1\)"),
        ({"weights": np.zeros((3, 2))}, r"weights has shape \(3, 2\); it must be \(2, 3\)"),
        ({"weights": np.zeros((2, 3), dtype=np.float32)}, "weights has type float32"),
        ({"counted": np.zeros(2, dtype=np.int64)}, r"counted has shape \(2,\); it must be \(1,\)"),
        ({"counted": np.zeros(1, dtype=np.int32)}, "counted has type int32"),
        ({"counted": np.broadcast_to(np.int64(0), 1)}, "counted is changed in place"),
    ],
)
def test_a_wrong_array_is_named(add, changes, message):
    add(**arguments())  # whether its shapes are known or not
    with pytest.raises(ValueError, match=message):
        add(**arguments(**changes))


def test_wrong_parameters_are_named(add):
    with pytest.raises(TypeError, match="weight"):
        add(**arguments(), weight=1)
    with pytest.raises(TypeError, match="more"):
        add(**{name: value for name, value in arguments().items() if name != "more"})


def test_constants_of_the_library_are_checked(library):
    add = SIGNATURE.of(library, K=3)
    assert add(**arguments()).sums.shape == (2, 3, 3)
    with pytest.raises(ValueError, match=r"numbers has shape \(2, 3\); it must be \(\.\.\., 4\)"):
        add(**arguments(numbers=np.zeros((2, 3))))


def test_sizes_that_no_array_tells_are_passed(library):
    signature = Signature(
        "add_all",
        "R K",
        more="real",
        numbers="R K+1 f8 optional",
        weights="R f8 optional",
        counted="1 i8 changed",
        sums="R K f8 out",
        large="R bool out optional",
    )
    sums, large = signature.of(library)(R=6, K=3, **arguments(numbers=np.arange(24.0).reshape(6, 4)))
    assert sums.shape == (6, 3)
    assert large.shape == (6,)
    with pytest.raises(ValueError, match=r"numbers has shape \(6, 4\); it must be \(5, 4\)"):
        signature.of(library)(R=5, K=3, **arguments(numbers=np.arange(24.0).reshape(6, 4)))


def test_shapes_are_forgotten_when_there_are_many(library, monkeypatch):
    monkeypatch.setattr("quad_swarm.native.signature._MOST_CHECKED", 3)
    add = SIGNATURE.of(library)
    for rows in (1, 2, 3, 4, 5, 1):
        assert add(**arguments(numbers=np.ones((rows, 4)))).sums.tolist() == [[2.0] * 3] * rows


def test_each_new_length_is_not_a_new_shape():
    """The number of answers differs from step to step."""
    source = Path(table.__file__).with_name(table.SOURCE).read_text(encoding="utf-8")
    compiled = Compiled(
        table.TABLE["receive"], ctypes.CDLL(str(build.build("pairs", table.SOURCE, {table.SOURCE: source}))), {}
    )

    def receive(answers: int, ages: np.ndarray | None) -> np.ndarray:
        pos, plans = np.zeros((6, 3)), np.zeros((6, 5, 3))
        return compiled.call(
            age=1,
            dt=0.1,
            misfit=np.inf,
            arriving=np.arange(6) < answers,
            received=np.ones((answers, 5, 3)),
            ages=ages,
            pos=pos,
            vel=pos,
            remembers=np.zeros(6, dtype=bool),
            known_age=np.full(6, 4),
            known=plans,
            remembered=None,
            believed=True,
            source=True,
        )[1]

    for answers in (3, 1, 6, 2):
        assert receive(answers, None)[:, 0, 0].tolist() == [1.0] * answers + [0.0] * (6 - answers)
        assert receive(answers, np.ones(answers, dtype=np.int64))[:, 0, 0].sum() == answers
    assert len(compiled._checked) == 2
    for ages in (np.ones(2, dtype=np.int64), np.array(1)):
        with pytest.raises(ValueError, match=r"ages has shape \(.*\); it must be \(3,\)"):
            receive(3, ages)
