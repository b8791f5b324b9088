"""Damage all kinds of files in many ways and try to load them.

``python -m studies.mutated_files [--count 10000] [--seed 0] [--json F]``. Each file must either be refused with a clear
error or be loaded, within a second and 1 GB, and without unpickling anything (all unpickling functions raise). JSON:
one row for each kind of file and damage with the numbers of refused and loaded files, and one for each failure.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import pickle
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import yaml
from stable_baselines3.common.vec_env import DummyVecEnv
from tqdm import tqdm

from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg import MADDPG, SafeVecNormalize, checkpoints
from sb3_maddpg.cli.safety import RunLoader
from sb3_maddpg.env_states import Replayable
from sb3_maddpg.team_tasks import OwnBit

SECONDS, BYTES = 1.0, 2**30
# Errors that a loader may raise; all others count as failures
REFUSALS = (ValueError, OSError, yaml.YAMLError)
_TRAP = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(print)).decode()}
NASTY: list[Any] = [
    None, True, -1, 10**30, 1e308, float("nan"), "", "x" * 1000, "../../x", [], {}, [[[[[[]]]]]], _TRAP,
    {"$": "class", "name": "os.system"}, {"$": "object", "class": "subprocess.Popen", "attributes": {"args": "true"}},
    {"$": "array", "dtype": "f8", "shape": [10**6, 10**6], "base64": "AAAAAAAAAAA=", "repeated": True},
    {"$": "array", "dtype": "O", "shape": [1], "base64": "AAAA"}, {"$": "MultiBinary", "n": 10**15},
    {"$": "Box", "low": 1, "high": 0}, {"$": "tuple", "items": 3}, {"$": "no such type"}, {"$": "Discrete", "n": -4},
    {"$": "class", "name": "sb3_maddpg.policies.MADDPGPolicy"}, {"$": "outside", "key": "99"},
]  # fmt: skip


def flip(content: bytes, rng: random.Random) -> bytes:
    """Flip some bits."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 30))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def truncate(content: bytes, rng: random.Random) -> bytes:
    """Cut off the end."""
    return content[: rng.randrange(len(content))]


def splice(content: bytes, rng: random.Random) -> bytes:
    """Insert a copy of one part elsewhere."""
    start, to = rng.randrange(len(content)), rng.randrange(len(content))
    return content[:to] + content[start : start + rng.randrange(1, 400)] + content[to:]


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zipped(members: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", compression) as archive:
        warnings.simplefilter("ignore")  # duplicate names cause warnings
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def members(content: bytes, rng: random.Random) -> bytes:
    """Swap, drop, duplicate, rename, add, inflate or damage members of a zip file."""
    found = list(_members(content).items())
    i, j = rng.randrange(len(found)), rng.randrange(len(found))
    kind = rng.choice(("swap", "drop", "double", "rename", "add", "bomb", "damage"))
    if kind == "swap":
        found[i], found[j] = (found[i][0], found[j][1]), (found[j][0], found[i][1])
    elif kind == "drop":
        del found[i]
    elif kind == "double":
        found.append((found[i][0], flip(found[i][1], rng)))
    elif kind == "rename":
        found[i] = (rng.choice(("../x", "/etc/x", "x.pth", "x.npy", "data/")), found[i][1])
    elif kind == "add":
        found.append((rng.choice(("../x", "x.pth", "x.npy", "x.pkl")), b"\0" * 100))
    elif kind == "bomb":
        found[i] = (found[i][0], b"\0" * 2**27)
        return _zipped(found, zipfile.ZIP_DEFLATED)
    else:
        found[i] = (found[i][0], rng.choice((flip, truncate, splice))(found[i][1] or b"\0", rng))
    return _zipped(found)


def _places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(one for key, value in inner for one in _places(value, (*path, key)))]


def _changed(text: bytes, rng: random.Random) -> bytes:
    """Replace a value of some JSON by a nasty one, or nest it deeply."""
    tree = json.loads(text)
    if rng.random() < 0.05:
        return text.replace(b"[", b"[" * rng.choice((60, 5000, 200_000)), 1)
    *path, last = rng.choice(_places(tree)[1:])
    owner = tree
    for key in path:
        owner = owner[key]
    owner[last] = rng.choice(NASTY)
    return json.dumps(tree).encode()


def values(content: bytes, rng: random.Random) -> bytes:
    """Change a value in a JSON file, or in a JSON member of a zip file."""
    if content[:2] != b"PK":
        return _changed(content, rng)
    found = _members(content)
    name = next(name for name in ("data", "buffer.json") if name in found)
    found[name] = _changed(found[name], rng)
    return _zipped(list(found.items()))


def tags(content: bytes, rng: random.Random) -> bytes:
    """Insert YAML that names Python objects or is deeply nested."""
    line = rng.choice(
        (
            b"- !!python/object/apply:os.system [echo]",
            b"- !!python/name:os.system",
            b"- !!python/object/new:subprocess.Popen [echo]",
            b"a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nd: [*c, *c]",
            b"[" * 3000,
            b"? [1]\n: {2: *nothing}",
        )
    )
    lines = content.splitlines()
    lines.insert(rng.randrange(len(lines) + 1), line)
    return b"\n".join(lines)


def files(folder: Path) -> dict[str, tuple[bytes, Callable[[Path], Any]]]:
    """Create a file of each kind, and return its content and its loader."""
    env = SafeVecNormalize(DummyVecEnv([lambda: Replayable(OwnBit())]))
    model = MADDPG("MlpPolicy", env, learning_starts=20, batch_size=8, train_freq=5, buffer_size=60, seed=0)
    model.learn(80, callback=[checkpoints.RunCheckpoint(folder / "run", 30)])
    model.save(folder / "model.zip")
    model.save(folder / "lean.zip", lean="actor")
    model.save_replay_buffer(folder / "buffer.pkl")
    env.save(str(folder / "stats.pkl"))
    (folder / "config.yml").write_text(
        yaml.dump({"policy": "MlpPolicy", "n_timesteps": 5, "env_kwargs": {"a": [1, 2]}}) * 3
    )
    found = checkpoints.newest(folder / "run")
    assert found is not None

    def checkpoint(name: str) -> Callable[[Path], Any]:
        def load(path: Path) -> None:
            content = path.read_bytes()
            (found / name).write_bytes(content)
            sums = {one.name: checkpoints._sha256(one) for one in found.iterdir() if one.name != "manifest.json"}
            if name != "manifest.json":  # as after deliberate damage
                (found / "manifest.json").write_text(json.dumps(sums))
            again = checkpoints.resume(folder / "run", env)
            if again is None:
                raise ValueError("passed over")

        return load

    def buffer(path: Path) -> None:
        model.load_replay_buffer(path)

    kinds: dict[str, Callable[[Path], Any]] = {
        "model.zip": lambda path: MADDPG.load(path, device="cpu"),
        "lean.zip": lambda path: MADDPG.load(path, device="cpu"),
        "buffer.pkl": buffer,
        "stats.pkl": lambda path: SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit])),
        "config.yml": lambda path: yaml.load(path.read_bytes(), RunLoader),
    }
    loaded = {name: ((folder / name).read_bytes(), load) for name, load in kinds.items()}
    names = ("manifest.json", "state.json", "arrays.npz")
    return loaded | {f"checkpoint {name}": ((found / name).read_bytes(), checkpoint(name)) for name in names}


def damages(name: str) -> list[Callable[[bytes, random.Random], bytes]]:
    """Return the damages that apply to a kind of file."""
    common: list[Callable[[bytes, random.Random], bytes]] = [flip, truncate, splice]
    if name.endswith(".yml"):
        return [*common, tags]
    if name.endswith(".json") or name == "stats.pkl":
        return [*common, values]
    return [*common, members, *([] if name.endswith("npz") else [values])]


def _poisoned(*args: Any, **kwargs: Any) -> Any:
    raise AssertionError("unpickled")


def attempt(load: Callable[[Path], Any], path: Path) -> tuple[str, str]:
    """Load a file.

    :return: "refused", "loaded" or the kind of failure, and the error
    """

    def late(*_: Any) -> None:
        raise TimeoutError

    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, 20 * SECONDS)
    outcome, told = "loaded", ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load(path)
    except AssertionError as error:
        outcome, told = "unpickled" if "unpickled" in str(error) else "raw error", traceback.format_exc()[-400:]
    except TimeoutError:
        outcome = "hangs"
    except REFUSALS as error:
        outcome, told = "refused", str(error)
    except BaseException:
        outcome, told = "raw error", traceback.format_exc()[-400:]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if time.process_time() - started > SECONDS:
        return "slow", f"{time.process_time() - started:.1f} s {told}"
    if 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) > BYTES:
        return "too large", told
    return outcome, told


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rng, tally, wrong = random.Random(args.seed), Counter[tuple[str, str, str]](), []
    poison = [
        patch(name, _poisoned) for name in ("pickle.load", "pickle.loads", "pickle.Unpickler", "cloudpickle.loads")
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kinds = files(folder)
        originals = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for one in poison:
            one.start()
        for kind, (content, load) in kinds.items():  # undamaged
            (folder / "file.dat").write_bytes(content)
            assert attempt(load, folder / "file.dat")[0] == "loaded", kind
        for _ in tqdm(range(args.count), disable=not sys.stderr.isatty()):
            kind = rng.choice(list(kinds))
            damage = rng.choice(damages(kind))
            content, load = kinds[kind]
            (folder / "file.dat").write_bytes(damage(content, rng))
            outcome, told = attempt(load, folder / "file.dat")
            tally[kind, damage.__name__, outcome] += 1
            if outcome not in ("refused", "loaded"):
                wrong.append({"file": kind, "damage": damage.__name__, "outcome": outcome, "error": told})
                print(f"{kind} {damage.__name__}: {outcome} {told}")
            if kind.startswith("checkpoint"):
                for path, original in originals.items():
                    if "run" in path.parts[-3:-1] or path.parent.parent == folder / "run":
                        path.write_bytes(original)
        for one in poison:
            one.stop()
    outcomes = sorted({outcome for _, _, outcome in tally})
    for kind, what in sorted({key[:2] for key in tally}):
        print(f"{kind:24} {what:10}", *(f"{outcome} {tally[kind, what, outcome]:5}" for outcome in outcomes))
    print(f"{args.count} files: {len(wrong)} failures")
    if args.json:
        rows = [{"file": k, "damage": d, "outcome": o, "count": count} for (k, d, o), count in sorted(tally.items())]
        write_rows(args.json, [*rows, *wrong])
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
