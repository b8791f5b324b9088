"""Archives: what comes back from them, each limit, and how often a file is opened."""

import io
import json
import struct
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_maddpg import MADDPG, SafeVecNormalize, untrusted
from sb3_maddpg.errors import InvalidFileError
from sb3_maddpg.files import archive
from sb3_maddpg.files.archive import Archive, opened, read_json, write_archive
from sb3_maddpg.files.model_files import refuse_pickled
from sb3_maddpg.team.toys import OwnBit

ARRAYS = {
    "floats": np.array([[1.5, -0.0], [np.inf, 3]], np.float32),
    "scalar": np.array(7),
    "none": np.zeros((0, 3)),
    "rows": np.zeros(2, [("a", "<f4", (2,)), ("b", "?")]),
    "columns first": np.asfortranarray(np.arange(6).reshape(2, 3)),
}


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> io.BytesIO:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as new:
        for name, content in members.items():
            new.writestr(name, content)
    return file


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_what_is_written_comes_back():
    file = io.BytesIO()
    write_archive(file, {"state.json": {"a": [1, "x"]}}, ARRAYS)
    found = Archive(file, "file")
    assert list(found.members) == ["state.json", *(f"{name}.npy" for name in ARRAYS)]
    assert found.json("state.json") == {"a": [1, "x"]}
    assert found.json("other.json") == {}
    back = found.arrays()
    for name, array in ARRAYS.items():
        assert (back[name].dtype, back[name].shape, back[name].tobytes()) == (array.dtype, array.shape, array.tobytes())
    file.seek(0)
    with np.load(file) as arrays:  # NumPy reads them, too
        assert np.array_equal(arrays["floats"], ARRAYS["floats"])
    with found.open("state.json") as member:
        assert member.read() == b'{"a": [1, "x"]}'


def test_arrays_of_pickles_are_not_written():
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        write_archive(io.BytesIO(), {}, {"x": np.array([print])})


@pytest.mark.parametrize("content", [b"", b"text", b"PK\5\6"])
def test_what_is_no_zip_file_is_refused(content):
    with pytest.raises(InvalidFileError, match=r"^file is damaged or holds something else: it is no zip file"):
        Archive(io.BytesIO(content), "file")


def test_a_missing_file_is_told_with_a_similar_one(tmp_path):
    (tmp_path / "best_model.zip").touch()
    with pytest.raises(FileNotFoundError, match=r"no such model file. Did you mean 'best_model.zip'\?: '.*bset_model"):
        MADDPG.load(tmp_path / "bset_model")
    with pytest.raises(FileNotFoundError, match=r"no such model file \(in the folder /[^?]*\): 'elsewhere/a.zip'$"):
        MADDPG.load("elsewhere/a.zip")


def test_two_members_of_one_name_are_refused():
    file = zipped({"a": b"1"})
    with warnings.catch_warnings(), zipfile.ZipFile(file, "a") as new:
        warnings.simplefilter("ignore")
        new.writestr("a", b"2")
    with pytest.raises(InvalidFileError, match="file is damaged: it has duplicate members"):
        Archive(file, "file")


def test_members_may_be_fifty_times_as_large_as_the_file_and_arrays_as_large_as_it():
    noise = np.random.default_rng(0).integers(256, size=1000, dtype=np.uint8)
    array = np.concatenate([noise, np.zeros(50_000, np.uint8)])
    file = zipped({"a.npy": npy(array)}, zipfile.ZIP_DEFLATED)
    assert 30 < array.size / len(file.getvalue()) < 50
    found = Archive(file, "file")
    assert np.array_equal(found.array("a.npy"), array)
    with pytest.raises(InvalidFileError, match=r"has members of 51128 bytes, more than the file has"):
        found.arrays()
    file = zipped({"a": bytes(noise), "b": bytes(40_000), "c": bytes(40_000)}, zipfile.ZIP_DEFLATED)
    assert 50 < 81_000 / len(file.getvalue()) < 60
    with pytest.raises(InvalidFileError, match=r"has members of 81000 bytes, more than the file has"):
        Archive(file, "file")


def lying(content: bytes, method: int, offset: int, size: int) -> io.BytesIO:
    """:return: a zip file of one member, whose directory holds another size at an offset of its entry"""
    file = zipped({"data": content}, method)
    raw = bytearray(file.getvalue())
    struct.pack_into("<I", raw, raw.rindex(b"PK\1\2") + offset, size)
    return io.BytesIO(raw)


def test_a_member_that_lies_about_its_size_is_refused_before_it_expands():
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with pytest.raises(InvalidFileError, match="compressed by a method that this library does not read"):
            Archive(lying(b" " * 10**6, method, 24, 100), "file")
    with pytest.raises(InvalidFileError, match="has members of 1000000 bytes, more than the file has"):
        Archive(lying(b"{}", zipfile.ZIP_STORED, 20, 10**6), "file")
    with pytest.raises(zipfile.BadZipFile, match="Bad CRC-32"):
        Archive(lying(b'{"a": 1}', zipfile.ZIP_DEFLATED, 24, 2), "file").json("data")


def test_json_is_limited(monkeypatch):
    monkeypatch.setattr(archive, "MOST_JSON", 10)
    assert Archive(zipped({"data": b'{"a": 123}'}), "file").json("data") == {"a": 123}
    with pytest.raises(InvalidFileError, match="file: data is too large: it has more than 10 bytes of JSON"):
        Archive(zipped({"data": b'{"a": 1234}'}), "file").json("data")
    assert read_json(io.BytesIO(b'{"a": 1234}'), "file", 11) == {"a": 1234}
    with pytest.raises(InvalidFileError, match="file is too large: it has more than 10 bytes of JSON"):
        read_json(io.BytesIO(b'{"a": 1234}'), "file", 10)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"[1]", "it holds a list instead of values by name"),
        (b"null", "it holds a NoneType instead"),
        (b"{", "its JSON cannot be read"),
        (b'{"a": "\xff"}', "its JSON cannot be read"),
        (b"[" * 100_000, r"its JSON cannot be read \(RecursionError: maximum recursion"),
    ],
)
def test_json_of_anything_but_values_by_name_is_refused(content, told):
    for read in (
        lambda: Archive(zipped({"data": content}), "file").json("data"),
        lambda: read_json(io.BytesIO(content), "file"),
    ):
        with pytest.raises(InvalidFileError, match=rf"^file.* is damaged: {told}[^\n]*$"):
            read()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (npy(np.zeros(4))[:-1], r"a\.npy has 159 bytes, not an array of float64 and shape \(4,\)"),
        (npy(np.zeros(4)) + b"x", r"a\.npy has 161 bytes"),
        (npy(np.zeros(4)).replace(b"(4,)", b"(9,)"), r"shape \(9,\)"),
        (npy(np.zeros(4)).replace(b"'<f8'", b"'|O' "), "not an array of object"),
    ],
)
def test_arrays_whose_header_does_not_fit_their_size_or_that_hold_pickles_are_refused(content, told, monkeypatch):
    monkeypatch.setattr(np.lib.format, "read_array", None)  # refused before
    with pytest.raises(InvalidFileError, match=told):
        Archive(zipped({"a.npy": content}), "file").array("a.npy")
    with pytest.raises(InvalidFileError, match=told):
        Archive(zipped({"x.json": b"{}", "a.npy": content}), "file").arrays()


def test_a_bit_that_flipped_in_an_array_is_found():
    content = npy(np.arange(4.0))
    raw = bytearray(zipped({"a.npy": content}).getvalue())
    raw[raw.index(content) + len(content) - 1] ^= 1
    with pytest.raises(zipfile.BadZipFile, match=r"Bad CRC-32 for file 'a\.npy'"):
        Archive(io.BytesIO(raw), "file").array("a.npy")


def test_what_is_no_array_is_refused_in_one_line():
    with (
        pytest.raises(InvalidFileError, match=r"is damaged or does not hold a buffer of sb3-maddpg \(ValueError"),
        opened(zipped({"a.npy": npy(np.zeros(4)), "x": b"text"}), "buffer") as file,
    ):
        Archive(file, "file").arrays()


def test_an_open_file_is_rewound_and_stays_open():
    file = io.BytesIO(b"0123")
    file.seek(2)
    with opened(file) as same:
        assert same.read() == b"0123"
    assert (file.tell(), file.closed) == (0, False)
    with pytest.raises(InvalidFileError, match=r"damaged .* \(KeyError: b'0123'\)"), opened(file) as same:
        {}[same.read()]
    assert file.tell() == 0
    for wrong in (None, 5, []):
        with pytest.raises(InvalidFileError, match="is neither a path nor a file"), opened(wrong):
            pass


def test_a_path_may_lack_the_suffix(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"a")
    (tmp_path / "b").write_bytes(b"b")
    for name in ("a", "a.zip", "b"):
        with opened(str(tmp_path / name), suffix="zip") as file:
            assert file.read() == name[:1].encode()
        assert file.closed
    for name, suffix in (("a", None), ("a.zip.zip", "zip"), ("c", "zip")):
        with pytest.raises(FileNotFoundError), opened(tmp_path / name, suffix=suffix):
            pass


_watched: dict[str, int] = {}


def _watch(event, args):
    if event == "open" and isinstance(args[0], (str, Path)) and (name := Path(args[0]).name) in _watched:
        _watched[name] += 1


def test_every_reader_opens_its_file_once(tmp_path):
    env = SafeVecNormalize(DummyVecEnv([OwnBit]))
    model = MADDPG("MlpPolicy", env, learning_starts=10, batch_size=8, buffer_size=50).learn(20)
    model.save(tmp_path / "model.zip")
    model.save(tmp_path / "pickled.zip", pickle=True)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    env.save(str(tmp_path / "statistics.pkl"))
    sys.addaudithook(_watch)  # which cannot be removed
    for name, read in {
        "model.zip": MADDPG.load,
        "pickled.zip": lambda path: MADDPG.load(path, trust=True),
        "buffer.pkl": model.load_replay_buffer,
        "statistics.pkl": lambda path: SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit])),
    }.items():
        further = (untrusted, *((model.set_parameters, lambda path: refuse_pickled(path, {})) * (name == "model.zip")))
        for one in (read, *further):
            _watched[name] = 0
            one(tmp_path / name)
            assert _watched.pop(name) == 1, (name, one)


def test_damaged_weights_are_called_by_their_cause(tmp_path):
    MADDPG("MlpPolicy", OwnBit(), buffer_size=50, batch_size=8).save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as old:
        members = {name: old.read(name) for name in old.namelist()}
        assert json.loads(members["data"])["algorithm"] == "MADDPG"
    raw = bytearray((tmp_path / "model.zip").read_bytes())
    raw[raw.index(members["policy.pth"]) + len(members["policy.pth"]) // 2] ^= 255
    (tmp_path / "model.zip").write_bytes(raw)
    with pytest.raises(
        InvalidFileError, match=r"model\.zip is damaged .*BadZipFile: Bad CRC-32 for file 'policy\.pth'"
    ):
        MADDPG.load(tmp_path / "model.zip")
