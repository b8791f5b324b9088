"""Files that appear whole, seeds, and what is finite."""

import os
import stat
import subprocess
import sys
import threading
import time
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import torch as th

from sb3_maddpg.utils import (
    all_finite,
    as_flag,
    as_number,
    as_numbers,
    as_seed,
    atomic_write,
    not_finite_at,
    shown,
    suggest,
)


def test_a_file_is_replaced_whole_and_its_folder_synced(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_ino))
    target = tmp_path / "new" / "model.zip"
    with atomic_write(target.with_suffix(""), suffix="zip") as file:
        file.write(b"one")
        assert not target.exists()
    assert synced == [target.stat().st_ino, target.parent.stat().st_ino]
    with suppress(RuntimeError), atomic_write(target, suffix="zip") as file:
        file.write(b"half")
        raise RuntimeError
    assert target.read_bytes() == b"one"
    assert os.listdir(target.parent) == ["model.zip"]


def test_a_path_that_cannot_be_written_is_refused_before_any_work(tmp_path):
    (tmp_path / "folder.zip").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "device.zip").symlink_to(os.devnull)
    for path, message in (
        (tmp_path / "folder", "This is a folder: pass the path of a file: '.*folder.zip'"),
        (tmp_path / "device", "This is a pipe or a device: pass the path of a file: '.*device.zip'"),
        ("", "This is a folder: pass the path of a file: '.*zip'"),
        ("..", "This is a folder: pass the path of a file: '.*zip'"),
        (tmp_path / "file" / "model", "Cannot write here .*choose another folder: '.*file/model.zip'"),
    ):
        worked = False
        with pytest.raises(OSError, match=message), atomic_write(path, suffix="zip"):
            worked = True
        assert not worked
    assert sorted(os.listdir(tmp_path)) == ["device.zip", "file", "folder.zip"]
    assert (tmp_path / "device.zip").is_symlink()


class Unspeakable:
    def __repr__(self):
        raise RuntimeError


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("a\nb", r"'a\nb'"),
        (np.zeros((2, 2)), "array([[0., 0.], [0., 0.]])"),
        (10**400, f"1{'0' * 99} ... {'0' * 66}"),
        ([10**5000], "<list>"),
        (Unspeakable(), "<Unspeakable>"),
    ],
)
def test_any_value_is_shown_in_a_short_line(value, text):
    assert shown(value) == text
    assert len(suggest("name", value, ["a"])) < 200


def test_numbers_are_real_numbers():
    assert as_numbers([[1, True], [2.5, 1e300]]).tolist() == [[1.0, 1.0], [2.5, np.inf]]
    for wrong in ("x", ["1"], [object()], {}, 1j, 10**400, [[1], [1, 2]], np.zeros(2, "datetime64[s]")):
        with pytest.raises(ValueError, match=r"no real numbers|inhomogeneous"):
            as_numbers(wrong)


def test_seeds_are_integers_of_any_type():
    assert [as_seed(seed) for seed in (None, 3, np.int64(3), True)] == [None, 3, 3, 1]
    assert type(as_seed(np.uint8(3))) is int
    for wrong in (-1, np.int64(-1), 2.5, "3"):
        with pytest.raises(ValueError, match="must be an integer of at least 0"):
            as_seed(wrong)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_one_number_that_is_not_finite_is_found(dtype, wrong):
    values = np.ones((3, 4), dtype)
    assert all_finite(values)
    values[2, 1] = wrong
    assert not all_finite(values)


def test_large_numbers_are_finite_if_single_precision_holds_them():
    assert all_finite(np.array([1e30, -3e38], np.float32))
    assert not all_finite(np.array([1e39]))
    assert all_finite(np.array([2**62]))


def test_the_first_number_that_is_not_finite_is_found_in_single_precision():
    values = np.zeros((2, 3))
    assert not_finite_at(values) is None
    values[1, 2] = 1e39
    assert not_finite_at(values) == (1, 2)


def test_what_killed_processes_left_of_a_file_is_removed(tmp_path):
    token = "-0123456789abcdef"
    killed, writing, other = (tmp_path / name for name in (".m.zip.999999999", f".m.zip.{os.getppid()}", ".n.zip.1"))
    recent = tmp_path / f".m.zip.999999998{token}"  # may be a process of another machine
    (tmp_path / f".m.zip.999999999{token}").touch()
    os.utime(tmp_path / f".m.zip.999999999{token}", (0, 0))
    for path in (killed, writing, other, recent):
        path.touch()
        if path != recent:
            os.utime(path, (0, 0))
    with atomic_write(tmp_path / "m", suffix="zip") as file:
        file.write(b"x")
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "m.zip", writing, other, recent])


def test_a_temporary_file_that_disappears_meanwhile_does_no_harm(tmp_path):
    gone = tmp_path / ".m.zip.999999998"
    gone.symlink_to(tmp_path / "renamed")  # is listed, but has no status, like a file that was renamed in between
    with atomic_write(tmp_path / "m", suffix="zip") as file:
        file.write(b"x")
    assert (tmp_path / "m.zip").read_bytes() == b"x"


def test_a_new_file_has_the_permissions_that_the_umask_leaves(tmp_path):
    program = (
        "import os, sys; from sb3_maddpg.utils import atomic_write; os.umask(int(sys.argv[2], 8))\n"
        "with atomic_write(sys.argv[1], 'zip') as file: file.write(b'x')"
    )
    for mask, mode in (("022", 0o644), ("077", 0o600), ("002", 0o664)):
        target = tmp_path / f"{mask}.zip"
        subprocess.run([sys.executable, "-c", program, str(target), mask], check=True)
        assert stat.S_IMODE(target.stat().st_mode) == mode


def test_threads_and_containers_that_write_one_file_leave_it_whole(tmp_path, monkeypatch):
    """In containers that share a folder, processes have the same ids."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    target, failed, over = tmp_path / "m.zip", [], threading.Event()
    contents = [bytes([number]) * 100_000 for number in range(4)]

    def write(content: bytes) -> None:
        try:
            for _ in range(15):
                with atomic_write(target, suffix="zip") as file:
                    file.write(content[:50_000])
                    time.sleep(0)
                    file.write(content[50_000:])
        except BaseException as error:
            failed.append(error)

    def read() -> None:
        while not over.is_set():
            with suppress(FileNotFoundError):
                if target.read_bytes() not in contents:
                    failed.append(AssertionError("damaged"))

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    reader = threading.Thread(target=read)
    for thread in (*threads, reader):
        thread.start()
    for thread in threads:
        thread.join()
    over.set()
    reader.join()
    assert not failed
    assert os.listdir(tmp_path) == ["m.zip"]
    assert target.read_bytes() in contents


def test_long_names_are_written_too(tmp_path):
    target = tmp_path / ("ü" * 120 + ".zip")
    with atomic_write(target, suffix="zip") as file:
        file.write(b"x")
    assert target.read_bytes() == b"x"


@pytest.mark.parametrize(
    "value", [2, 2.0, True, np.float16(2), np.longdouble(2), np.array(2), th.tensor(2.0), Fraction(2), Decimal(2)]
)
def test_numbers_of_every_type_become_pythons(value):
    assert as_number(value) == (1.0 if value is True else 2.0)
    assert type(as_number(value)) is float


@pytest.mark.parametrize(
    "value", [None, "2", 2j, np.array([2.0]), [2], 10**400, np.ma.masked, th.tensor(2.0, requires_grad=True), object()]
)
def test_what_is_no_single_number_is_refused(value):
    with pytest.raises(ValueError, match="no real number"):
        as_number(value)


def test_flags_are_one_or_zero():
    assert [as_flag(value) for value in (True, 1, 0.0, np.bool_(False), np.array(1), th.tensor(True))] == [
        True, True, False, False, True, True,
    ]  # fmt: skip
    for value in (2, 0.5, np.nan, None, "False", np.array([True])):
        with pytest.raises(ValueError, match=r"neither True nor False|no real number"):
            as_flag(value)


def test_what_is_masked_is_no_number():
    assert as_numbers(np.ma.array([1.0, 2.0])).tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="no real numbers"):
        as_numbers(np.ma.array([1.0, 2.0], mask=[False, True]))
