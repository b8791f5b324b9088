"""Damage all kinds of files in many ways, try to load them, and use what loads.

``python -m studies.mutated_files [--count 10000] [--used 2000] [--seed 0] [--json F]``. Each file must be refused
with a clear error in one line, or be loaded, within a second and 1 GB, and without unpickling anything (all unpickling
functions raise). In files of ``--used``, one or two values are replaced by plausible ones; what loads then predicts,
gets an environment, learns and is saved, which must work or be refused in one line. JSON: one row for each kind of file
and damage with the numbers of refused and loaded files, and one for each failure.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import os
import pickle
import random
import resource
import shutil
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

import numpy as np
import yaml
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from tqdm import tqdm

from quad_swarm.evaluation.rows import write_rows
from quad_swarm.world.anticipation import PREDICTORS, load_predictor
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm
from sb3_maddpg import MADDPG, MATD3, PrioritizedTeamReplayBuffer, SafeVecNormalize, checkpoints
from sb3_maddpg.checkpoints.commit import sha256
from sb3_maddpg.cli.safety import RunLoader
from sb3_maddpg.team.toys import FollowTarget, OwnBit
from sb3_maddpg.vec_env.states import Replayable

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


def _similar(value: Any, rng: random.Random) -> Any:
    """Return a value that could stand in place of another one."""
    others: list[Any] = [None, [], {}, "x", 0, -1, True, 0.5]
    if isinstance(value, bool):
        others = [not value, None, "true", int(value), []]
    elif isinstance(value, (int, float)):
        others = [value + 1, -value, 2 * value, 0, -1, 1, 0.5, None, "1", [value], True]
        others += [10**30, 2**63 - 1, 1e39, {"$": "float", "value": rng.choice(("nan", "inf", "-inf"))}]
    elif isinstance(value, str):
        others = ["", "x", value + "x", None, 1, value[:-1]]
    elif isinstance(value, list):
        others = [[], value[:-1], value + value[:1], value[::-1], None, 1, [None] * len(value)]
    elif isinstance(value, dict):
        others = [None, {}, 1, "x", [], {key: one for key, one in value.items() if rng.random() < 0.7}]
        others += [{"$": "float", "value": "nan"}] * ("base64" in value)
    return rng.choice(others)


# With any number of these, a training is only long
_LONG = ("gradient_steps", "train_freq", "frequency", "policy_delay", "learning_starts", "_last_episode_starts")


def plausible(content: bytes, rng: random.Random) -> bytes:
    """Replace one or two values of a JSON file, of a JSON member or of an array."""
    if content[:2] != b"PK":
        return _plausible_json(content, rng)
    found = _members(content)
    texts = [name for name in ("data", "buffer.json") if name in found]
    name = rng.choice(texts) if texts and rng.random() < 0.8 else rng.choice(list(found))
    if name in texts:
        found[name] = _plausible_json(found[name], rng)
    elif name.endswith(".npy"):
        found[name] = _plausible_array(found[name], rng)
    return _zipped(list(found.items()))


def _plausible_json(text: bytes, rng: random.Random) -> bytes:
    tree = json.loads(text)
    for _ in range(rng.choice((1, 1, 2))):
        # Every name as often as the others, however many values it holds
        top = rng.choice(list(tree))
        *path, last = rng.choice(_places(tree[top], (top,)))
        if {*path, last} & {*_LONG}:
            continue
        owner = tree
        for key in path:
            owner = owner[key]
        owner[last] = _similar(owner[last], rng)
    return json.dumps(tree).encode()


def _plausible_array(content: bytes, rng: random.Random) -> bytes:
    array = np.load(io.BytesIO(content), allow_pickle=False).copy()
    kind = rng.choice(("shape", "dtype", "value", "value"))
    if array.dtype.kind == "U":
        text = str(array)
        array = np.array(text[: rng.randrange(len(text))])
    elif kind == "shape":
        array = array[:-1] if array.ndim else array[None]
    elif kind == "dtype":
        array = array.astype(rng.choice((np.float64, np.float32, np.int64, np.uint8)))
    elif array.size:
        value = rng.choice((np.nan, np.inf, -1, 0, 1e30, 3))
        with np.errstate(all="ignore"):
            array.flat[rng.randrange(array.size)] = np.array(value).astype(array.dtype)
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


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
    recipe = {"policy": "MlpPolicy", "n_timesteps": 5, "env_kwargs": {"a": [1, 2]}}
    again = {f"{key}_{k}": value for k in range(2) for key, value in recipe.items()}
    (folder / "config.yml").write_text(yaml.dump(recipe | again))
    shutil.copy(PREDICTORS["flight"], folder / "predictor.npz")
    found = checkpoints.newest(folder / "run")
    assert found is not None

    def checkpoint(name: str) -> Callable[[Path], Any]:
        def load(path: Path) -> None:
            content = path.read_bytes()
            (found / name).write_bytes(content)
            sums = {one.name: sha256(one) for one in found.iterdir() if one.name != "manifest.json"}
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
        "predictor.npz": lambda path: load_predictor(str(path.rename(path.with_suffix(".npz")))),
    }
    loaded = {name: ((folder / name).read_bytes(), load) for name, load in kinds.items()}
    names = ("manifest.json", "state.json", "arrays.npz")
    return loaded | {f"checkpoint {name}": ((found / name).read_bytes(), checkpoint(name)) for name in names}


def _fly_with(path: Path) -> None:
    """Fly with the predictor of a file."""
    predictor = str(path.rename(path.with_suffix(".npz")))
    swarm = Swarm(make_config("flight-v3", predictor=predictor, n_robots=3))
    swarm.reset(0, np.array([[0.0, 0, 1], [2, 0, 1], [0, 2, 1]]), np.array([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]]))
    for _ in range(3):
        swarm.step(np.zeros((1, 3, 2), bool))
    assert np.isfinite(swarm.state).all()


def used_files(folder: Path) -> dict[str, tuple[bytes, Callable[[Path], Any]]]:
    """Create a file of each kind, and return its content and a function that loads it and uses all that it holds."""
    made: dict[str, tuple[bytes, Callable[[Path], Any]]] = {}
    settings: dict[str, Any] = {"learning_starts": 20, "batch_size": 8, "train_freq": 5, "buffer_size": 60, "seed": 0}
    prioritized: dict[str, Any] = {"replay_buffer_class": PrioritizedTeamReplayBuffer, "n_steps": 2}

    def env() -> SafeVecNormalize:
        return SafeVecNormalize(DummyVecEnv([lambda: Replayable(OwnBit())]))

    def learn_on(model: MADDPG) -> None:
        for _ in range(2):
            model.learn(30, reset_num_timesteps=False)
        model.save(io.BytesIO())
        model.save_replay_buffer(io.BytesIO())

    def use(model: MADDPG, make: Callable[[], Any]) -> None:
        observation = model.observation_space.sample()
        model.predict(observation, deterministic=True)
        model.agent_policy(0)
        model.set_env(make())
        learn_on(model)

    kinds: dict[str, tuple[type[MADDPG], Callable[[], Any], dict[str, Any]]] = {
        "bits": (MADDPG, env, settings),
        "prioritised": (MADDPG, OwnBit, settings | prioritized),
        "continuous": (MATD3, FollowTarget, settings | {"action_noise": NormalActionNoise(np.zeros(2), np.ones(2))}),
    }
    for name, (cls, make, arguments) in kinds.items():
        model = cls("MlpPolicy", make(), **arguments).learn(80)
        model.save(folder / f"{name}.zip")
        model.save_replay_buffer(folder / f"{name}.pkl")

        def load_model(path: Path, cls: type[MADDPG] = cls, make: Callable[[], Any] = make) -> None:
            use(cls.load(path, device="cpu"), make)

        def load_buffer(path: Path, cls: type[MADDPG] = cls, make: Callable[[], Any] = make, name: str = name) -> None:
            model = cls.load(folder / f"{name}.zip", env=make(), device="cpu")
            model.load_replay_buffer(path)
            learn_on(model)

        made[f"used {name} model"] = ((folder / f"{name}.zip").read_bytes(), load_model)
        made[f"used {name} buffer"] = ((folder / f"{name}.pkl").read_bytes(), load_buffer)
    statistics = env()
    MADDPG("MlpPolicy", statistics, **settings).learn(80)
    statistics.save(str(folder / "statistics.pkl"))

    def load_statistics(path: Path) -> None:
        found = SafeVecNormalize.load(str(path), DummyVecEnv([OwnBit]))
        learn_on(MADDPG("MlpPolicy", found, **settings))
        found.save(str(folder / "again.pkl"))

    made["used statistics"] = ((folder / "statistics.pkl").read_bytes(), load_statistics)

    made["used predictor"] = PREDICTORS["flight"].read_bytes(), _fly_with

    def callbacks() -> list[BaseCallback]:
        return [StopTrainingOnMaxEpisodes(10**6), EvalCallback(env(), eval_freq=50, n_eval_episodes=1, verbose=0)]

    run = folder / "used run"
    MADDPG("MlpPolicy", env(), **settings, **prioritized).learn(80, [*callbacks(), checkpoints.RunCheckpoint(run, 30)])
    whole = folder / "whole run"
    shutil.copytree(run, whole)

    def resume(path: Path) -> None:
        shutil.rmtree(run)
        shutil.copytree(whole, run)
        found = checkpoints.newest(run)
        assert found is not None
        content = path.read_bytes()
        (found / ("arrays.npz" if content[:2] == b"PK" else "state.json")).write_bytes(content)
        sums = {one.name: sha256(one) for one in found.iterdir() if one.name != "manifest.json"}
        (found / "manifest.json").write_text(json.dumps(sums))
        again = checkpoints.resume(run, env())
        if again is None:
            raise ValueError("passed over")
        model, checkpoint = again
        model.learn(60, [*callbacks(), checkpoint], reset_num_timesteps=False)
        checkpoint.save()

    newest = checkpoints.newest(run)
    assert newest is not None
    return made | {f"used {name}": ((newest / name).read_bytes(), resume) for name in ("state.json", "arrays.npz")}


def damages(name: str) -> list[Callable[[bytes, random.Random], bytes]]:
    """Return the damages that apply to a kind of file."""
    if name.startswith("used"):
        return [plausible]
    common: list[Callable[[bytes, random.Random], bytes]] = [flip, truncate, splice]
    if name.endswith(".yml"):
        return [*common, tags]
    if name.endswith(".json") or name == "stats.pkl":
        return [*common, values]
    return [*common, members, *([] if name.endswith("npz") else [values])]


def _poisoned(*args: Any, **kwargs: Any) -> Any:
    raise AssertionError("unpickled")


def attempt(load: Callable[[Path], Any], path: Path, used: bool = False) -> tuple[str, str]:
    """Load a file.

    :param used: whether what it holds is used, too, which may take longer
    :return: "refused", "loaded" or the kind of failure, and the error
    """

    def late(*_: Any) -> None:
        raise TimeoutError

    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, 20 * SECONDS)
    outcome, told = "loaded", ""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            load(path)
    except AssertionError as error:
        outcome, told = "unpickled" if "unpickled" in str(error) else "raw error", traceback.format_exc()[-900:]
    except TimeoutError:
        outcome = "hangs"
    except REFUSALS as error:
        outcome, told = (
            "refused" if isinstance(error, yaml.YAMLError) or len(str(error).splitlines()) == 1 else "many lines",
            str(error),
        )
    except BaseException:
        outcome, told = "raw error", traceback.format_exc()[-900:]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if not used and time.process_time() - started > SECONDS:
        return "slow", f"{time.process_time() - started:.1f} s {told}"
    if 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) > BYTES:
        return "too large", told
    return outcome, told


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--used", type=int, default=2_000, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    rng, tally, wrong = random.Random(args.seed), Counter[tuple[str, str, str]](), []
    started_in = Path.cwd()
    poison = [
        patch(name, _poisoned) for name in ("pickle.load", "pickle.loads", "pickle.Unpickler", "cloudpickle.loads")
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded, used = files(folder), used_files(folder)
        kinds = loaded | used
        here = folder / "here"  # what a file makes relative to the current folder
        here.mkdir()
        os.chdir(here)
        originals = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for one in poison:
            one.start()
        for kind, (content, load) in kinds.items():  # undamaged
            (folder / "file.dat").write_bytes(content)
            assert attempt(load, folder / "file.dat", True)[0] == "loaded", kind
        chosen = [list(loaded)] * args.count + [list(used)] * args.used
        for names in tqdm(chosen, disable=not sys.stderr.isatty()):
            kind = rng.choice(names)
            damage = rng.choice(damages(kind))
            content, load = kinds[kind]
            (folder / "file.dat").write_bytes(damage(content, rng))
            outcome, told = attempt(load, folder / "file.dat", kind in used)
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
        os.chdir(started_in)
    outcomes = sorted({outcome for _, _, outcome in tally})
    for kind, what in sorted({key[:2] for key in tally}):
        print(f"{kind:24} {what:10}", *(f"{outcome} {tally[kind, what, outcome]:5}" for outcome in outcomes))
    print(f"{args.count + args.used} files: {len(wrong)} failures")
    if args.json:
        rows = [{"file": k, "damage": d, "outcome": o, "count": count} for (k, d, o), count in sorted(tally.items())]
        write_rows(args.json, [*rows, *wrong])
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
