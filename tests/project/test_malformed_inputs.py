"""
Malformed input of every kind, drawn from a seed: each case is refused in one line that names what is wrong, or works.

The tests run a sample of each area. ``python tests/project/test_malformed_inputs.py --all`` runs every case and prints
a table, ``--area NAME`` those of one area. Every case runs in a process of its own, which ends after a time limit.
"""

# ruff: noqa: E402, E501, C901 - also a script, with long tables and lists of cases

import argparse
import collections
import contextlib
import io
import json
import os
import pickle
import random
import resource
import select
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[1] / "helpers")]  # where this is run as a script

import gymnasium
import known
import known_wrapped
import numpy as np
import odd_parts
import odd_worlds
import pytest
import torch as th
import yaml
from cases import Case, Silent, Theirs
from foreign import Stay
from gymnasium import spaces

import quad_swarm
import sb3_maddpg
import sb3_maddpg.team.toys  # registers the tasks
from faulty import Faulty, trained
from quad_swarm.planner import SOLVERS
from sb3_maddpg import MADDPG, MATD3, pretrained
from sb3_maddpg.cli.main import main as command_line
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.utils import shown
from toys import SMALL

SEED = 0
SECONDS = 20  # a case that takes longer hangs
MEMORY = 4 << 30  # that a case may take
CLEAR = (ValueError, OSError, ImportError, gymnasium.error.Error)
PACKAGES = [str(Path(package.__file__).parent) for package in (sb3_maddpg, quad_swarm)]
VERDICTS = ("clear", "works", "foreign", "raw", "hang", "silent")
GOOD = ("clear", "works", "foreign")
GYMNASIUM = str(Path(gymnasium.__file__).parent)
LONGEST = 700  # characters of a message
QUICK: dict[str, Any] = {**SMALL, "learning_starts": 10, "batch_size": 8, "buffer_size": 200}
NONSENSE: tuple[Any, ...] = (
    None, "", "false", "x", "1e-3", b"x", np.nan, np.inf, -np.inf, -1, -0.5, 0, 0.5, 1, 2, 2.5, 7, 10**9, 1e300, 10**400,
    1j, True, False, [], [1], [np.nan], (), (1, 2), ("a", "b"), {}, {"x": 1}, {1: 2}, set(), object(), int, print,
    np.float32(0.5), np.int64(3), np.float64("nan"), np.array([]), np.array([1.0, 2.0]), np.array(["x"]), spaces.Discrete(2),
    10**5000,
)  # fmt: skip


class Verdict(NamedTuple):
    """What became of a case: one of ``VERDICTS``, and the message. Foreign is what Gymnasium raises before our code."""

    kind: str
    told: str


def judge(case: Case) -> Verdict:
    """Run a case in this process."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            case.run()
    except _Refused as error:
        return Verdict("clear", str(error))
    except Silent as error:
        return Verdict("silent", str(error))
    except Theirs as error:
        return Verdict("foreign", str(error))
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        where, told = frames[-1], f"{type(error).__name__}: {error}"
        # Gymnasium knows which ids exist, and Stable-Baselines3 shapes
        own = isinstance(error, gymnasium.error.Error) or "observation shape" in str(error) or _is_in(where, PACKAGES)
        own = own or (isinstance(error, OSError) and error.filename is not None)
        if isinstance(error, CLEAR) and own and _is_readable(str(error).strip()):
            return Verdict("clear", told)
        told = f"{told} [{Path(where.filename).name}:{where.lineno}]"
        reached = any(_is_in(frame, PACKAGES) for frame in frames)
        return Verdict("foreign" if _is_in(where, [GYMNASIUM]) and not reached else "raw", told)
    return Verdict("works", "")


def _is_in(frame: traceback.FrameSummary, packages: list[str]) -> bool:
    return any(frame.filename.startswith(package + os.sep) for package in packages)


def _is_readable(text: str) -> bool:
    """Whether it is one line of a length to read, and not Python's own about numbers that it does not write."""
    return "\n" not in text and len(text) <= LONGEST and "integer string conversion" not in text


def address_space() -> int:
    """What this process, with all that other tests have loaded, takes already (bytes)."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[0]) * resource.getpagesize() if statm.exists() else 0


def judge_apart(case: Case, seconds: float = SECONDS) -> Verdict:
    """Run a case in a process and a folder of its own."""
    for _ in range(2):  # a fork may wait for a lock that a thread of another test held
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            verdict = _judge_in(folder, case, seconds)
        if verdict.kind != "hang":
            break
    return verdict


def _judge_in(folder: str, case: Case, seconds: float) -> Verdict:
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        os.setpgid(0, 0)
        devnull = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(devnull, descriptor)
        os.chdir(folder)
        limit = address_space() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        verdict = judge(case)
        os.write(writer, json.dumps([verdict.kind, verdict.told[:3000]]).encode())
        os._exit(0)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.setpgid(child, child)
    os.close(writer)
    ready, _, _ = select.select([reader], [], [], seconds)
    written = os.read(reader, 1 << 16) if ready else b""
    os.close(reader)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    if not ready:
        return Verdict("hang", f"longer than {seconds} s")
    return Verdict(*json.loads(written)) if written else Verdict("raw", "the process died")


# What is right of what was accepted


def check_model(model: MADDPG) -> None:
    """Parameters are finite, and so is what the model does."""
    for name, tensor in model.policy.state_dict().items():
        if not th.isfinite(tensor).all():
            raise Silent(f"{name} is not finite")
    obs = np.random.default_rng(0).normal(size=model.observation_space.shape).astype(np.float32)
    action = model.predict(obs, deterministic=True)[0]
    if not model.action_space.contains(action):
        raise Silent(f"acts {action!r}")


def check_learns(model: MADDPG, steps: int = 60) -> None:
    model.learn(steps)
    check_model(model)


def check_flies(env: gymnasium.Env, n_steps: int = 5) -> None:
    """Observations and rewards of some steps are finite."""
    rng = np.random.default_rng(0)
    obs, _ = env.reset(seed=0)
    for _ in range(n_steps):
        shape = env.action_space.shape
        obs, reward, *_ = env.step(rng.integers(0, 2, shape))
        if not (np.isfinite(obs).all() and np.isfinite(reward).all()):
            raise Silent(f"observation or reward is not finite: {reward}")
    env.close()


# a. Model files


class Files:
    """A folder with two trained models, to spoil."""

    def __init__(self, folder: Path):
        self.folder = folder
        model = MADDPG("MlpPolicy", "OwnBit-v0", **QUICK)
        model.learn(60)
        self.binary = folder / "binary.zip"
        model.save(self.binary)
        self.buffer = folder / "buffer.pkl"
        model.save_replay_buffer(self.buffer)
        self.pairs = folder / "pairs.zip"
        swarm = gymnasium.make("QuadSwarm-v0", n_robots=3, observation="state+plan")
        MADDPG("PairPolicy", swarm, **QUICK).learn(60).save(self.pairs)
        self.members = {path: _members(path) for path in (self.binary, self.pairs)}

    def write(self, members: dict[str, bytes] | bytes) -> Path:
        path = self.folder / f"spoilt-{os.getpid()}.zip"
        if isinstance(members, bytes):
            path.write_bytes(members)
            return path
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, content)
        return path


def _members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _saved(value: Any) -> bytes:
    file = io.BytesIO()
    th.save(value, file)
    return file.getvalue()


def _torch(content: bytes) -> Any:
    return th.load(io.BytesIO(content), weights_only=True)


def model_files(files: Files, rng: random.Random) -> Iterator[Case]:
    for path, members in files.members.items():
        raw = path.read_bytes()
        spoilt: dict[str, Any] = {}
        for _ in range(14):
            end = rng.randrange(len(raw))
            spoilt[f"cut at {end}"] = raw[:end]
        for _ in range(30):
            flipped, at = bytearray(raw), rng.randrange(len(raw))
            flipped[at] ^= 1 << rng.randrange(8)
            spoilt[f"flip at {at}"] = bytes(flipped)
        for name, content in members.items():
            cut = rng.randrange(len(content))
            at = rng.randrange(len(content))
            spoilt[f"without {name}"] = {key: value for key, value in members.items() if key != name}
            for what, new in {
                "empty": b"", "cut": content[:cut], "garbage": rng.randbytes(100), "text": b"{}",
                "flip": content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :],
            }.items():  # fmt: skip
                spoilt[f"{name}: {what}"] = {**members, name: new}
        spoilt["one more member"] = {**members, "more": b"x"}
        spoilt["one more network"] = {**members, "critic_2.optimizer.pth": members["critic.optimizer.pth"]}
        swapped = {"actor.optimizer.pth": members["critic.optimizer.pth"]}
        spoilt["optimizers swapped"] = {**members, **swapped, "critic.optimizer.pth": members["actor.optimizer.pth"]}
        spoilt["of another team"] = {**next(m for p, m in files.members.items() if p != path), "data": members["data"]}
        data = json.loads(members["data"])
        for text in ("", "{", "[]", "null", "1", '"x"', "NaN", "{}", '{"algorithm": "MADDPG"}', "\xff"):
            spoilt[f"data = {text!r}"] = {**members, "data": text.encode("latin-1")}
        for key in data:
            rest = {name: value for name, value in data.items() if name != key}
            spoilt[f"data without {key}"] = {**members, "data": json.dumps(rest).encode()}
            for value in rng.sample([None, "x", float("nan"), [], {}, -1, 1e300, "false", [None], {"a": 1}], 3):
                spoilt[f"data[{key}] = {value!r}"] = {**members, "data": json.dumps({**data, key: value}).encode()}
        for value in ("MATD3", "TD3", "x", "", 5, [], None):
            spoilt[f"algorithm = {value!r}"] = {**members, "data": json.dumps({**data, "algorithm": value}).encode()}
        for value in (1, 3, "2", 2.0, None, [], True):
            spoilt[f"file_format = {value!r}"] = {
                **members,
                "data": json.dumps({**data, "file_format": value}).encode(),
            }
        state = _torch(members["policy.pth"])
        for name in rng.sample(list(state), min(6, len(state))):
            tensor = state[name]
            for what, new in {
                "nan": tensor * np.nan, "inf": tensor + np.inf, "double": tensor.double(), "whole": tensor.long(),
                "longer": th.cat([tensor, tensor]), "flat": tensor.flatten(), "complex": tensor.to(th.complex64),
                "a list": [1.0], "None": None, "empty": tensor[:0], "huge": tensor.double() + 1e300,
            }.items():  # fmt: skip
                spoilt[f"{name} {what}"] = {**members, "policy.pth": _saved({**state, name: new})}
            rest = {key: value for key, value in state.items() if key != name}
            spoilt[f"no {name}"] = {**members, "policy.pth": _saved(rest)}
        spoilt["unknown parameter"] = {**members, "policy.pth": _saved({**state, "more": th.zeros(2)})}
        for value in ([], {}, th.zeros(3), 5, "x", None):
            for name in ("policy.pth", "actor.optimizer.pth", "pytorch_variables.pth"):
                spoilt[f"{name} = {value!r}"] = {**members, name: _saved(value)}
        optimizer = _torch(members["actor.optimizer.pth"])
        first = next(iter(optimizer["state"]))
        for what, new in {
            "nan": th.full_like(optimizer["state"][first]["exp_avg"], np.nan), "shape": th.zeros(2), "list": [1.0],
        }.items():  # fmt: skip
            entry = {**optimizer["state"][first], "exp_avg": new}
            changed = {**optimizer, "state": {**optimizer["state"], first: entry}}
            spoilt[f"exp_avg {what}"] = {**members, "actor.optimizer.pth": _saved(changed)}
        for what, value in {"lr": np.nan, "betas": None, "params": [0], "eps": -1.0}.items():
            groups = [{**optimizer["param_groups"][0], what: value}]
            spoilt[f"optimizer {what}"] = {
                **members,
                "actor.optimizer.pth": _saved({**optimizer, "param_groups": groups}),
            }

        def load(content: Any, path: Path = path) -> None:
            model = MADDPG.load(files.write(content))
            check_model(model)
            if path == files.binary:
                model.set_env(gymnasium.make("OwnBit-v0"))
                check_learns(model, 30)

        def set_parameters(content: Any, path: Path = path) -> None:
            model = MADDPG.load(path)
            model.set_parameters(files.write(content))
            check_model(model)

        def evaluate(content: Any) -> None:
            _call("evaluate", "--policy", str(files.write(content)), "--scenario", "random", "--episodes", "1",
                  "--max-steps", "3", "--solver", "rti")  # fmt: skip

        for what, content in spoilt.items():
            yield Case(f"MADDPG.load({path.stem}: {what})", lambda content=content, load=load: load(content))
        for what in rng.sample(list(spoilt), 40):
            content = spoilt[what]
            yield Case(f"set_parameters({path.stem}: {what})", lambda c=content, f=set_parameters: f(c))
            if path == files.pairs:
                yield Case(f"evaluate {what}", lambda c=content, f=evaluate: f(c))
    for name in ("empty", "text", "folder", "no file"):
        for loader in (
            MADDPG.load,
            MATD3.load,
            lambda path: _call("evaluate", "--policy", str(path), "--episodes", "1"),
        ):
            yield Case(f"a model's zip is {name}", lambda name=name, loader=loader: loader(_no_zip(files.folder, name)))
    yield Case("MATD3.load(MADDPG's)", lambda: MATD3.load(files.binary))
    for value in NONSENSE:
        yield Case(f"MADDPG.load({shown(value)})", lambda value=value: MADDPG.load(value))
        yield Case(f"pretrained({shown(value)})", lambda value=value: pretrained(value))
        yield Case(
            f"set_parameters({shown(value)})", lambda value=value: MADDPG.load(files.binary).set_parameters(value)
        )


def _no_zip(folder: Path, name: str) -> Path:
    path = folder / f"none-{name}.zip"
    if name == "folder":
        path.mkdir(exist_ok=True)
    elif name != "no file":
        path.write_text("" if name == "empty" else "x" * 100)
    return path


# b. Arguments of the environments

FIELDS = {
    "reward": ("goal", "collision", "request", "near_miss", "near_miss_distance", "near_miss_width", "near_miss_ahead"),
    "planner": (
        "horizon", "dt", "separation", "max_tilt", "max_climb_rate", "max_speed", "workspace_low", "workspace_high",
        "goal_weight", "input_weight", "repulsion_buffer", "violation_weight", "max_neighbours",
    ),
    "noise": ("pos", "vel", "attitude", "wind"),
    "radio": ("loss", "delay", "range", "half_distance", "path_loss_exponent"),
    "space": ("half_width", "heights", "spacing", "circle_radius", "circle_jitter", "sector_radius", "whole_sectors"),
    "world": ("n_robots", "radius", "collision_tolerance", "goal_radius", "memory", "quadrotor", "noise", "space"),
}  # fmt: skip
ARGUMENTS = (
    "preset", "scenario", "n_robots", "max_steps", "observation", "scale_observation", "continuous_collisions",
    "end_at_arrival", "memory", "reward", "planner", "noise", "radio", "space", "world", "solver", "render_mode",
)  # fmt: skip
WORTH_TRYING = {
    "scenario": ("paper", "random", {"random": 0}, {"random": -1}, {"random": np.nan}, {"random": "x"}, {"x": 1}),
    "observation": ("paper+memory", "state+", "+", "state+state", "state+memory+plan", "plan"),
    "solver": ("fatrop", "RTI"),
    "n_robots": (2, 3, 500, "4"),
}


def environments(files: Files, rng: random.Random) -> Iterator[Case]:
    def make(how: str, arguments: dict[str, Any]) -> None:
        arguments = {"solver": "rti", **arguments}
        makers: dict[str, Callable[..., Any]] = {
            "make": lambda **kwargs: gymnasium.make("QuadSwarm-v0", **kwargs),
            "make_vec": lambda **kwargs: gymnasium.make_vec("QuadSwarm-v0", num_envs=2, **kwargs),
            "parallel_env": lambda **kwargs: quad_swarm.parallel_env(**kwargs).team,
        }
        try:
            check_flies(makers[how](**arguments))
        except quad_swarm.planner.BuildError:  # another kernel, which takes too long to compile here
            if rng.random() < 0.1:
                check_flies(makers[how](**{**arguments, "solver": "fatrop"}), 2)

    def cases(arguments: dict[str, Any], ways: tuple[str, ...] = ("make",)) -> Iterator[Case]:
        for how in ways:
            yield Case(f"{how}({shown(arguments)})", lambda how=how: make(how, arguments))

    ways = ("make", "make_vec", "parallel_env")
    for name in ARGUMENTS:
        for value in (*NONSENSE, *WORTH_TRYING.get(name, ())):
            yield from cases({name: value}, ("make", rng.choice(ways[1:])))
    for name, fields in FIELDS.items():
        for field in fields:
            for value in rng.sample(NONSENSE, 14):
                yield from cases({name: {field: value}}, (rng.choice(ways),))
    for _ in range(80):
        yield from cases({rng.choice(ARGUMENTS): _nested(rng, 3)}, (rng.choice(ways),))
    for value in NONSENSE:
        yield Case(f"num_envs={shown(value)}", lambda value=value: check_flies(
            gymnasium.make_vec("QuadSwarm-v0", num_envs=value, solver="rti")))  # fmt: skip
        yield Case(f"pass {shown(value)}", lambda value=value: quad_swarm.parallel_env(value))
        yield Case(f"episode_length={shown(value)}", lambda value=value: check_flies(
            gymnasium.make("OwnBit-v0", episode_length=value)))  # fmt: skip


def _nested(rng: random.Random, depth: int) -> Any:
    names = [field for fields in FIELDS.values() for field in fields] + list(FIELDS) + ["x", 1, None]
    if depth == 0 or rng.random() < 0.2:
        return rng.choice(NONSENSE)
    return {rng.choice(names): _nested(rng, depth - 1) for _ in range(rng.randrange(1, 4))}


# c. Command line and recipes


def _call(*words: str) -> None:
    """Call the command line: raises what it prints, with the type that says how good that is."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        try:
            status = command_line(list(words))
        except SystemExit as error:
            status = error.code or 0
    if status == 0:
        return
    lines = [line for line in errors.getvalue().strip().splitlines() if "Warning" not in line]
    last = lines[-1] if lines else ""
    if status not in (1, 2) or "error: " not in last or "Traceback" in errors.getvalue():
        raise RuntimeError(f"status {status}: {errors.getvalue()[-500:]}")
    raise _Refused(last)


class _Refused(Exception):
    """The command line refused it in one line."""


RECIPE: dict[str, Any] = {
    "n_timesteps": 60, "policy": "MlpPolicy", "learning_starts": 10, "batch_size": 8, "train_freq": 5, "buffer_size": 200,
    "policy_kwargs": {"net_arch": [8]},
}  # fmt: skip
KEYS = (
    *RECIPE, "n_envs", "learning_rate", "tau", "gamma", "gradient_steps", "n_steps", "estimator", "temperature",
    "exploration_noise", "max_grad_norm", "policy_delay", "policy_regularization", "threshold_price", "normalize",
    "env_kwargs", "eval_env_kwargs", "env_wrapper", "vec_env", "vec_env_wrapper", "callback", "frame_stack",
    "noise_type", "noise_std", "monitor_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "action_noise",
)  # fmt: skip
YAML_VALUES = (
    "null",
    "''",
    "x",
    ".nan",
    ".inf",
    "-1",
    "0",
    "1e300",
    "[]",
    "[x]",
    "{}",
    "{x: 1}",
    "true",
    "2020-01-01",
    "0.5",
)
WORDS = ("", "x", "nan", "-1", "0", "1.5", "1e9", "[", "{", "None", "é", "../..", "--", "a:b", "\0")
BROKEN = (
    "", "[]", "- 1", "5", "x", "null", "{", "a: b: c", "\t- x", "OwnBit-v0:", "OwnBit-v0: []", "OwnBit-v0: 5",
    "OwnBit-v0: {}", "OwnBit-v0: nan", "default: {}", "x: {}", "OwnBit-v0: {1: 2}", "OwnBit-v0: {policy: MlpPolicy}",
    "OwnBit-v0: &a [*a]", "OwnBit-v0: !!python/object:os.system {}", "? [a]\n: b", "OwnBit-v0: {policy: x, n_timesteps: 5}",
    "OwnBit-v0: {null: 1}", "OwnBit-v0: {<<: 5}", "%YAML 9\n---\n", "OwnBit-v0: {n_timesteps: 20, n_timesteps: 5}",
)  # fmt: skip
OPTIONS = {
    "train": (
        "--algo", "--env", "-i", "-n", "--num-threads", "--log-interval", "--eval-freq", "--eval-episodes",
        "--n-eval-envs", "--save-freq", "-f", "--seed", "--vec-env", "--device", "--verbose", "--env-kwargs",
        "--eval-env-kwargs", "-params", "--conf-file", "--gym-packages", "-tb",
    ),
    "evaluate": (
        "--policy", "--seed", "--preset", "--n-robots", "--max-steps", "--world", "--algo", "--solver", "--scenario",
        "--episodes", "--jobs", "--json", "--plot", "--env", "--gym-packages",
    ),
    "replay": ("--policy", "--seed", "--preset", "--n-robots", "--max-steps", "--world", "--scenario", "--episode", "--out"),
    "bench": ("--algo", "--env", "-n", "--json", "-params", "--env-kwargs"),
    "tune": ("--n-trials", "--n-jobs", "--sampler", "--pruner", "--n-startup-trials", "--storage", "--trial-id", "-n"),
    "enjoy": ("--env", "--algo", "-f", "-n", "--exp-id", "--load-checkpoint", "--seed", "--env-kwargs", "--n-envs"),
    "record": ("--env", "-f", "-n", "-o"),
}  # fmt: skip
POLICIES = ("", "x", "none:1", "cpa", "cpa:x:1", "cpa:nan:1", "cpa:-1:2", "random:2", "random:nan", "none&", "|", "a.zip",
            "a.zip@x", "pretrained:", "pretrained:x", "latest:", "latest:x", "pretrained:quad-swarm-paper@nan",
            "pretrained:quad-swarm-paper@2", "pretrained:quad-swarm-paper@-1", "distance:inf", "stale:1.5", "full&none|")  # fmt: skip
WORLDS = ("x", "=", "x=1", "noise=1", "noise.wind=x", "noise.wind=nan", "noise.wind=-1", "radius=0", "n_robots=2",
          "noise.wind=[", "memory={", "a.b.c=1", "planner.horizon=1", "radius=.inf", "noise.=1", ".wind=1")  # fmt: skip


def commands(files: Files, rng: random.Random) -> Iterator[Case]:
    swarm = ("--policy", "none", "--solver", "rti", "--max-steps", "3")
    bases = {
        "train": ("--env", "OwnBit-v0", "-n", "60", "-f", "logs", "--eval-freq", "-1"),
        "evaluate": (*swarm, "--episodes", "1", "--scenario", "random"),
        "replay": (*swarm, "--scenario", "random", "--out", "replay.html"),
        "bench": ("--env", "OwnBit-v0", "-n", "60"),
        "tune": ("--env", "OwnBit-v0", "-n", "60", "--n-trials", "1", "-f", "logs"),
        "enjoy": ("--env", "OwnBit-v0", "-f", "logs", "-n", "5", "--no-render"),
        "record": ("--env", "OwnBit-v0", "-f", "logs", "-n", "5"),
    }

    def run(*words: str, recipe: str | None = None) -> None:
        if recipe is not None:
            Path("recipe.yml").write_text(recipe)
            words = (*words, "--conf-file", "recipe.yml")
        _call(*words)

    def case(*words: str, recipe: str | None = None) -> Case:
        shown = f" of {recipe!r}" if recipe is not None else ""
        return Case(f"{' '.join(map(repr, words))}{shown}", lambda: run(*words, recipe=recipe))

    for command, options in OPTIONS.items():
        for option in options:
            for word in rng.sample(WORDS, 6):
                yield case(command, *bases[command], option, word)
        yield case(command)
        yield case(command, "--no-such-option")
        yield case(command, *bases[command], "x")
    for policy in POLICIES:
        yield case("evaluate", *bases["evaluate"], "--policy", policy)
    for world in WORLDS:
        yield case(
            rng.choice(["evaluate", "replay"]), *bases["evaluate"][:-4], "--scenario", "random", "--world", world
        )
    for words in ([], ["x"], [""], ["--x"], ["pretrained", "x"], ["pretrained", "--out", "x"], ["pretrained", "a", "b"],
                  ["pretrained", "quad-swarm-paper", "--out", "/proc/x"], ["pretrained", ""]):  # fmt: skip
        yield case(*words)
    for value in ("x", "gamma", "gamma:", ":1", "gamma:x", "gamma:nan", "gamma:2", "x:1", "gamma:[1", "batch_size:0",
                  "learning_rate:lin_x", "learning_rate:lin_nan", "policy:x", "n_envs:0", "callback:x", "gamma:print(1)",
                  "policy_kwargs:5", "policy_kwargs:{net_arch: x}", "env_wrapper:os.path", "normalize:5", "n_envs:1e9"):  # fmt: skip
        yield case("train", *bases["train"], "-params", value)
        yield case("train", *bases["train"], "--env-kwargs", value)
    train = ("train", "--env", "OwnBit-v0", "-f", "logs", "--eval-freq", "-1")
    for text in BROKEN:
        yield case(*train, recipe=text)
    for key in KEYS:
        for value in rng.sample(YAML_VALUES, 6):
            text = yaml.safe_dump({**RECIPE, key: "VALUE"}, default_flow_style=True, width=1000)
            yield case(*train, "-n", "60", recipe="OwnBit-v0: " + text.replace("VALUE", value))
    for words in (["train"], ["evaluate", "--policy", "x"], ["x"], ["pretrained", "x"], ["bench", "-n", "0"]):
        yield Case(f"python -m sb3_maddpg {words}", lambda words=words: _subprocess(words))


def _subprocess(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sb3_maddpg", *words], capture_output=True, text=True, check=False, timeout=60
    )
    if done.returncode not in (1, 2) or "Traceback" in done.stderr or "error: " not in done.stderr:
        raise RuntimeError(f"{done.returncode}: {done.stderr[-300:]}")
    raise _Refused(done.stderr.strip().splitlines()[-1])


# d. Environments that misbehave


def faulty_environments(files: Files, rng: random.Random) -> Iterator[Case]:
    def run(seed: int) -> None:
        env = Faulty(seed)
        result = trained(env)
        if isinstance(result, MADDPG):
            check_model(result)
            kept = result.replay_buffer
            if not all(np.isfinite(array).all() for array in (kept.observations, kept.next_observations, kept.numbers)):
                raise Silent("the replay buffer is not finite")
            return
        if env.agent not in str(result) and "faulty" not in str(result):
            raise RuntimeError(f"names nobody: {result}")
        raise result

    for seed in range(1000, 1200):
        yield Case(repr(Faulty(seed)), lambda seed=seed: run(seed))


# e. Actions, resets and what models are asked


def _swarm() -> gymnasium.Env:
    return gymnasium.make("QuadSwarm-v0", solver="rti", max_steps=3)


def _swarms() -> Any:
    return gymnasium.make_vec("QuadSwarm-v0", num_envs=3, solver="rti", max_steps=3)


def _agents() -> Any:
    return quad_swarm.parallel_env(solver="rti", max_steps=3)


SPOILT_ACTIONS: dict[str, Callable[[np.ndarray], Any]] = {
    "one less": lambda bits: bits.ravel()[:-1],
    "one more": lambda bits: np.append(bits, 1),
    "other shape": lambda bits: np.resize(bits, (2, bits.size)),
    "one more axis": lambda bits: bits[None],
    "a column": lambda bits: bits.reshape(-1, 1),
    "transposed": lambda bits: np.resize(bits, bits.shape[::-1] if bits.ndim > 1 else (1, bits.size)),
    "empty": lambda bits: bits.ravel()[:0],
    "nan": lambda bits: bits * np.nan,
    "inf": lambda bits: bits + np.inf,
    "halves": lambda bits: bits * 0.5,
    "twos": lambda bits: bits + 2,
    "negative": lambda bits: -bits,
    "text": lambda bits: bits.astype(str),
    "words": lambda bits: np.full(bits.shape, "x"),
    "objects": lambda bits: np.full(bits.shape, None),
    "complex": lambda bits: bits * 1j,
    "None": lambda bits: None,
    "a word": lambda bits: "x",
    "a number": lambda bits: 1,
    "a dict": lambda bits: {"x": bits},
    "an object": lambda bits: object(),
    "ragged": lambda bits: [[1], [1, 0]],
    "a set": lambda bits: {0, 1},
    "huge": lambda bits: bits * 1e300,
    "dates": lambda bits: bits.astype("datetime64[s]"),
}


def interfaces(files: Files, rng: random.Random) -> Iterator[Case]:
    def step(make: Callable[[], Any], spoil: Callable[[np.ndarray], Any]) -> None:
        env = make()
        env.reset(seed=0)
        if isinstance(env, quad_swarm.QuadSwarmParallelEnv):
            actions = {agent: np.ones(3, np.int8) for agent in env.agents}
            given = actions["robot_2"] = spoil(actions["robot_2"])
        else:
            actions = given = spoil(np.ones(env.action_space.shape, np.int8))
        env.step(actions)
        raise Silent(f"{given!r} is taken for bits")

    for make in (_swarm, _swarms, _agents):
        for name, spoil in SPOILT_ACTIONS.items():
            yield Case(f"{make.__name__}: step({name})", lambda make=make, spoil=spoil: step(make, spoil))
        for value in NONSENSE:
            yield Case(f"{make.__name__}: reset(seed={shown(value)})", lambda make=make, v=value: make().reset(seed=v))
            yield Case(
                f"{make.__name__}: reset(options={shown(value)})", lambda make=make, v=value: make().reset(options=v)
            )
            yield Case(f"{make.__name__}: level {shown(value)}", lambda make=make, v=value: _level(make(), v))
        for name, call in {
            "step before reset": lambda env: env.step(env.action_space.sample() if hasattr(env.action_space, "sample")
                                                      else {agent: [0, 0, 0] for agent in env.possible_agents}),
            "render before reset": lambda env: env.render(),
            "close twice": lambda env: (env.close(), env.close()),
            "steps after the end": lambda env: [env.reset(seed=0), *(env.step(_zeros(env)) for _ in range(6))],
        }.items():  # fmt: skip
            yield Case(f"{make.__name__}: {name}", lambda make=make, call=call: call(make()))
    goals = np.ones((4, 3)) * np.arange(4)[:, None]
    for starts in (*NONSENSE, np.zeros((4, 3)), np.full((4, 3), np.nan), np.full((4, 3), 1e300), np.zeros((3, 4)),
                   np.zeros((5, 3)), [[0, 0, 1]] * 4, np.array([["x"] * 3] * 4), np.full((4, 3), 1e30)):  # fmt: skip
        yield Case(f"starts={shown(starts)}", lambda s=starts: _placed({"starts": s, "goals": goals}))
        yield Case(f"goals={shown(starts)}", lambda s=starts: _placed({"starts": goals, "goals": s}))
    for actions in (None, {}, [], {"robot_0": [0, 0, 0]}, {**dict.fromkeys(["robot_0", "robot_1", "robot_2", "robot_3"])},
                    np.zeros((4, 3)), "x"):  # fmt: skip
        yield Case(f"parallel step({shown(actions)})", lambda a=actions: [(env := _agents()).reset(), env.step(a)])

    observations = {
        "one less": (1, 2),
        "one more": (1, 4),
        "two": (2, 2),
        "flat": (3,),
        "none": (0,),
        "many": (5, 1, 3),
    }
    for path, shape in ((files.binary, None), (files.pairs, None)):

        def ask(call: Callable[[MADDPG, tuple], Any], path: Path = path) -> Any:
            model = MADDPG.load(path)
            return call(model, model.observation_space.shape)

        for name, shape in observations.items():
            yield Case(f"{path.stem}: predict({name})", lambda a=ask, s=shape: a(lambda m, _: _acts(m, np.zeros(s))))
        for name, spoil in SPOILT_ACTIONS.items():
            if name not in ("negative", "halves", "twos", "huge", "one more axis"):  # these are observations
                yield Case(
                    f"{path.stem}: predict({name})",
                    lambda a=ask, spoil=spoil: a(lambda m, full: _acts(m, spoil(np.ones(full)))),
                )
        for value in NONSENSE:
            for name, call in {
                "predict": lambda m, _, v=value: _acts(m, v),
                "set_threshold": lambda m, _, v=value: (m.set_threshold(v), check_model(m)),
                "agent_policy": lambda m, _, v=value: m.agent_policy(v),
                "set_env": lambda m, _, v=value: m.set_env(v),
                "save": lambda m, _, v=value: m.save(v),
                "save_replay_buffer": lambda m, _, v=value: m.save_replay_buffer(v),
                "load_replay_buffer": lambda m, _, v=value: m.load_replay_buffer(v),
                "learn": lambda m, _, v=value: (m.set_env(gymnasium.make("OwnBit-v0")), m.learn(v), check_model(m)),
                "agent_policy.predict": lambda m, _, v=value: m.agent_policy(0).predict(v),
                "agent_policy.export": lambda m, _, v=value: m.agent_policy(0).export(v),
                "resized": lambda m, _, v=value: m.resized(v),
                "callback": lambda m, _, v=value: (m.set_env(gymnasium.make("OwnBit-v0")), m.learn(20, callback=v)),
            }.items():
                if name in ("learn", "callback") and (path != files.binary or value is NONSENSE[17]):  # 10**9 steps
                    continue
                yield Case(f"{path.stem}: {name}({shown(value)})", lambda a=ask, call=call: a(call))
        for where in (files.folder / "no" / "such" / "x", Path("/proc/x"), files.folder, Path("/dev/full")):
            for name in ("save", "save_replay_buffer"):
                yield Case(f"{name}({where.name})", lambda a=ask, n=name, w=where: a(lambda m, _: getattr(m, n)(w)))
            yield Case(f"export({where.name})", lambda a=ask, w=where: a(lambda m, _: m.agent_policy(0).export(w)))
    for env in ("CartPole-v1", "Pendulum-v1", "no-such", "OwnBit", ""):
        yield Case(f"set_env({env})", lambda env=env: MADDPG.load(files.binary).set_env(gymnasium.make(env)))
        yield Case(f"load(env={env})", lambda env=env: MADDPG.load(files.binary, env=gymnasium.make(env)))
        yield Case(f"MADDPG(env={env!r})", lambda env=env: MADDPG("MlpPolicy", env, **QUICK))
    for value in NONSENSE:
        yield Case(f"env={shown(value)}", lambda v=value: MADDPG("MlpPolicy", v, **QUICK))
        yield Case(f"policy={shown(value)}", lambda v=value: MADDPG(v, "OwnBit-v0", **QUICK))
        yield Case(f"pretrained(env={shown(value)})", lambda v=value: pretrained("quad-swarm-paper", env=v))


def _level(env: Any, value: Any) -> None:
    getattr(env, "unwrapped", env).set_curriculum_level(value)


def _zeros(env: Any) -> Any:
    if isinstance(env, quad_swarm.QuadSwarmParallelEnv):
        return {agent: np.zeros(3, np.int8) for agent in env.agents}
    return np.zeros(env.action_space.shape, np.int8)


def _placed(options: dict[str, Any]) -> None:
    env = _swarm()
    obs, _ = env.reset(seed=0, options=options)
    for _ in range(3):
        if not np.isfinite(obs).all():
            raise Silent("the observation is not finite")
        obs, *_ = env.step(_zeros(env))


def _acts(model: MADDPG, obs: Any) -> None:
    action = model.predict(obs)[0]
    if np.isfinite(np.asarray(obs, float)).all() and model.action_space.contains(action):
        return
    raise Silent(f"acts {action!r}")


# f. Arguments of algorithms, and replay buffers

POLICY_ARGUMENTS = (
    "net_arch", "activation_fn", "share_actor", "share_critic", "threshold", "random_thresholds", "n_critics",
    "agent_names", "normalize_images", "optimizer_class", "optimizer_kwargs",
)  # fmt: skip
BUFFER_ARGUMENTS = ("n_steps", "gamma", "n_pairs", "handle_timeout_termination", "optimize_memory_usage", "alpha", "x")
ALGORITHM_ARGUMENTS = (
    "learning_rate", "buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq", "gradient_steps",
    "action_noise", "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage", "n_steps", "use_action_cost",
    "threshold_price", "exploration_noise", "estimator", "temperature", "policy_delay", "max_grad_norm",
    "policy_regularization", "policy_kwargs", "stats_window_size", "tensorboard_log", "verbose", "seed", "device",
)  # fmt: skip
EXTREME = {
    "learning_rate": (1e6, 1e30, lambda _: np.nan, lambda _: "x", lambda _: -1.0, lambda: 1.0),
    "temperature": (1e-5, 1e30, lambda _: np.nan, lambda _: 0.0, lambda _: "x"),
    "threshold_price": ((1e-12, 1e12), (1, 1), (2, 1), (np.nan, 1), (0, 1), ("a", 1)),
    "train_freq": ((1, "x"), (1, "episode"), (0, "step"), ("x", "step"), (2, "step", 3)),
    "exploration_noise": ((1, np.nan), (1, 2, 3), 1e300),
    "policy_regularization": (1e300, 1e30),
    "net_arch": ([0], [8, -1], ["x"], [10**7, 10**7], {"pi": [8]}, {"pi": [8], "qf": "x"}, [[8]]),
    "share_actor": ([[0, 0]], [[0, 9]], [["x"]], [[0], [0, 1]]),
}


def algorithms(files: Files, rng: random.Random) -> Iterator[Case]:
    def train(algorithm: type[MADDPG], **kwargs: Any) -> None:
        check_learns(algorithm("MlpPolicy", "OwnBit-v0", **{**QUICK, **kwargs}))

    def case(algorithm: type[MADDPG], **kwargs: Any) -> Case:
        return Case(f"{algorithm.__name__}({shown(kwargs)})", lambda: train(algorithm, **kwargs))

    for algorithm, names in ((MADDPG, ALGORITHM_ARGUMENTS), (MATD3, ("target_policy_noise", "target_noise_clip"))):
        for name in names:
            for value in (*NONSENSE, *EXTREME.get(name, ())):
                # 10**9 steps are no mistake, and take a year
                if name not in ("gradient_steps", "train_freq") or value is not NONSENSE[17]:
                    yield case(algorithm, **{name: value})
    for name in POLICY_ARGUMENTS:
        for value in (*NONSENSE, *EXTREME.get(name, ())):
            yield case(MADDPG, policy_kwargs={"net_arch": [8], name: value})
    for name in BUFFER_ARGUMENTS:
        for value in NONSENSE:
            yield case(MADDPG, replay_buffer_kwargs={name: value})
    for name in ("alpha", "beta", "epsilon", "x"):
        for value in rng.sample(NONSENSE, 20):
            kwargs = {
                "replay_buffer_class": sb3_maddpg.PrioritizedTeamReplayBuffer,
                "replay_buffer_kwargs": {name: value},
            }
            yield case(MADDPG, **kwargs)

    def load(content: bytes) -> None:
        path = files.folder / f"buffer-{os.getpid()}.pkl"
        path.write_bytes(content)
        model = MADDPG.load(files.binary, env=gymnasium.make("OwnBit-v0"))
        model.load_replay_buffer(path)
        check_learns(model, 30)

    written = files.buffer.read_bytes()
    pickles: dict[str, bytes] = {f"cut at {end}": written[:end] for end in rng.sample(range(len(written)), 15)}
    for value in (None, [], {}, 5, "x", np.zeros(3)):
        pickles[repr(value)] = pickle.dumps(value)
    pickles |= {"empty": b"", "text": b"x" * 50, "a model": files.binary.read_bytes()}
    for name, content in pickles.items():
        yield Case(f"load_replay_buffer({name})", lambda content=content: load(content))


AREAS: dict[str, Callable[[Files, random.Random], Iterator[Case]]] = {
    "model files": model_files,
    "environments' arguments": environments,
    "command line and recipes": commands,
    "misbehaving environments": faulty_environments,
    "actions, resets, models": interfaces,
    "algorithms' arguments, buffers": algorithms,
    "what environments return": lambda files, rng: known.returns(rng),
    "wrappers": lambda files, rng: known_wrapped.wrapped(rng),
    "worlds that do not fit": lambda files, rng: odd_worlds.worlds(rng, _call),
    "foreign parts": lambda files, rng: odd_parts.parts(rng),
}
LETTERS = "abcdefghij"[: len(AREAS)]
SAMPLE = 12  # of each area, in the tests


def prepare(folder: Path) -> Files:
    """Import and compile here what every case would have to."""
    th.set_num_threads(1)
    load_environments()
    for make in (_swarm, _swarms, _agents):
        env = make()
        env.reset(seed=0)
        env.step(_zeros(env))
    SOLVERS["stay"] = Stay
    os.environ["CXX"] = "no-such-compiler"  # only kernels that are there already: compiling takes too long
    return Files(folder)


def cases_of(area: str, files: Files) -> list[Case]:
    return list(AREAS[area](files, random.Random(SEED)))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:  # puts back what `prepare` sets
        patch.setenv("CXX", "")
        patch.setitem(SOLVERS, "stay", Stay)
        yield prepare(tmp_path_factory.mktemp("malformed"))


@pytest.mark.slow
@pytest.mark.parametrize("area", AREAS)
def test_malformed_input_is_refused_in_one_line_or_works(area, files):
    cases = cases_of(area, files)
    bad = {}
    for case in random.Random(SEED + 1).sample(cases, SAMPLE):
        verdict = judge_apart(case)
        if verdict.kind not in GOOD:
            bad[case.name] = verdict
    assert not bad


def main() -> int:
    """Run all cases and print a table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--all", action="store_true", help="every area (the default)")
    parser.add_argument("--area", nargs="+", choices=[*AREAS, *LETTERS], default=[], help="some areas, also by letter")
    parser.add_argument("--match", default="", help="only cases whose names hold this")
    parser.add_argument("--most", type=int, help="so many cases of each area at most, drawn")
    parser.add_argument("--log", type=Path, help="write what became of every case")
    args = parser.parse_args()
    chosen = {LETTERS.index(name) if len(name) == 1 else list(AREAS).index(name) for name in args.area}
    log = args.log.open("w", buffering=1) if args.log else None
    with tempfile.TemporaryDirectory() as folder:
        files = prepare(Path(folder))
        rows, bad = [], []
        for index, area in enumerate(AREAS):
            if chosen and index not in chosen:
                continue
            found = collections.Counter[str]()
            cases = [case for case in cases_of(area, files) if args.match in case.name]
            for case in random.Random(SEED).sample(cases, min(len(cases), args.most or len(cases))):
                verdict = judge_apart(case)
                found[verdict.kind] += 1
                if log:
                    print(json.dumps([area, case.name, *verdict]), file=log)
                if verdict.kind not in GOOD:
                    bad.append(f"{verdict.kind:7} {area}: {case.name[:200]}\n        {verdict.told[-300:]}")
            rows.append((area, sum(found.values()), *(found[kind] for kind in VERDICTS)))
    print("\n".join(bad))
    print(f"{'area':32}{'tried':>8}" + "".join(f"{kind:>8}" for kind in VERDICTS))
    for area, *numbers in rows:
        print(f"{area:32}" + "".join(f"{number:>8}" for number in numbers))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
