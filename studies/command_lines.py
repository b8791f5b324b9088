"""Type many wrong command lines, and show many damaged run folders.

``python -m studies.command_lines [--count 5000] [--seed 0] [--json F]``. Each command must either be accepted, print
its usage, or print one line that says what is wrong. None may raise any other error, run code, start a process or write
outside its folder, which Python's audit events tell. JSON: one row for each kind of command with the numbers of its
outcomes, and one for each failure.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import yaml
from tqdm import tqdm

from quad_swarm.evaluation import command as evaluation
from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg.cli import study, training
from sb3_maddpg.cli.main import main as command_line
from sb3_maddpg.cli.safety import RunLoader

SECONDS = 60.0
_EVENTS = (
    *("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "pty.spawn"),
    *("pickle.find_class", "socket.connect", "ctypes.dlopen", "webbrowser.open"),
)
_CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.truncate", "os.symlink", "os.link", "os.chmod")
TRAP = (
    "from pathlib import Path\nPath(__file__).with_name('caught').touch()\ndef parallel_env(): ...\nclass Trap: ...\n"
)
VICTIM = "../victim"
NASTY: list[Any] = [
    None, True, -1, 0, 10**30, -(10**400), 1e308, float("nan"), float("inf"), "", " ", "x", "x" * 3000, "²", "٣", "\0",
    "a\nb", "../x", "/etc/passwd", "~", VICTIM, [], {}, [[1]], [[[[[]]]]], {"a": {"b": {"c": []}}}, [None], {"": 1},
    "os.system", "lurking.Trap", "lurking", "os", ".", "a..b", "__import__('os').system('x')", "1/0", "lin_",
    "tuple(1)", "list(5)", "dict(a=1)", "dict(", "[" * 3000, "-" * 3000 + "1", "(" * 300, "not " * 3000 + "a",
    "!!timestamp 1", "[!!timestamp 1]", "[!!int '']", "{? [1] : 2}", "&a [*a]", "0x" + "f" * 5000, "1" * 5000, "1_0",
    {"os.system": {"command": "x"}}, {"lurking.Trap": {}}, {"--folder=x": 1}, {"-o": VICTIM}, {"a b": "c\nd"},
    {"gymnasium.wrappers.TimeLimit": {}}, {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": "x"}},
    {"stable_baselines3.common.monitor.Monitor": {"filename": VICTIM}}, {"gymnasium.wrappers.FlattenObservation": {}},
    {"stable_baselines3.common.callbacks.CheckpointCallback": {"save_freq": 5, "save_path": VICTIM}},
    {"gymnasium.wrappers.RecordVideo": {"video_folder": VICTIM}}, "nn.Nope", "lin_nan", 1, 2, 0.5, "0.25", False,
    {"stable_baselines3.common.vec_env.VecFrameStack": {}}, {"stable_baselines3.common.vec_env.VecCheckNan": {}},
    {"gymnasium.wrappers.TransformObservation": {"func": "x"}}, {"a": 1, "b": 2}, b"\xff", ("a", 1),
]  # fmt: skip
RECIPE: dict[str, Any] = {"n_timesteps": 100, "policy": "MlpPolicy", "buffer_size": 500, "batch_size": 16}
KEYS = (
    *("n_timesteps", "policy", "n_envs", "callback", "env_kwargs", "env_wrapper", "eval_env_kwargs", "frame_stack"),
    *("monitor_kwargs", "noise_type", "noise_std", "normalize", "vec_env", "vec_env_wrapper", "learning_rate", "gamma"),
    *("batch_size", "train_freq", "gradient_steps", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"),
    *(
        "exploration_noise",
        "estimator",
        "temperature",
        "n_steps",
        "threshold_price",
        "tau",
        "buffer_siz",
        "X",
        "preset",
    ),
)
OPTIONS = (
    *("-n", "--seed", "--eval-freq", "--n-eval-envs", "--save-freq", "--log-interval", "--device", "--num-threads"),
    *("--conf-file", "--gym-packages", "--checkpoint-every", "--resume", "-i", "--algo", "--env", "--verbose"),
    *("--trial-id", "--storage", "--study-name", "--seeds", "--jobs", "--engine", "--vec-env", "--nonsense", "-zz"),
)
WORLD = ("n_robots", "quadrotor", "noise", "noise.wind", "planner", "plant", "radius", "x", "", "a.b.c", "max_tilt")
POLICIES = (
    *("full", "none", "cpa", "cpa:", "cpa:x", "cpa:1:2:3:4", "latest:", "latest:x", "pretrained:", "pretrained:x"),
    *(
        "x.zip",
        "x.zip@2",
        "latst:logs",
        "@",
        "nope",
        "lurking",
        "cpa:1e400",
        "cpa:nan",
        "random:2",
        "distance:-1",
    ),
)


class AcceptedError(BaseException):
    """The command began to work."""


class Recorder:
    """What the interpreter does that a command line or a file must not make it do. Only one can be active."""

    def __init__(self, folder: Path):
        self.folder, self.caught = folder.resolve(), list[str]()
        self.active = False
        # Compiled Python, and what libraries keep for this user
        self._caches = [Path(os.devnull), Path.home() / ".cache", Path(tempfile.gettempdir(), "SB3-")]
        sys.addaudithook(self._hear)

    @contextlib.contextmanager
    def listening(self) -> Iterator[list[str]]:
        self.caught, self.active = [], True
        try:
            yield self.caught
        finally:
            self.active = False

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.active:
            return
        # Videos, and the compiled planner
        programs = ("ffmpeg", "ffplay", "/quad_swarm/", "/proc/self/fd/")  # the last is a checked library
        expected = any(word in str(arguments[:2]) for word in programs)
        if event in _EVENTS and not expected:
            self.caught.append(f"{event} {arguments[:1]}")
        writes = (
            event == "open" and len(arguments) == 3 and (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        )
        if (writes or event in _CHANGES) and isinstance(arguments[0], (str, bytes, os.PathLike)):
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if path.startswith(("/dev/", *map(str, (self.folder, *self._caches)))) or "__pycache__" in path:
                return
            self.caught.append(f"{event} {path}")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


def parameters(rng: random.Random, folder: Path) -> list[str]:
    """Give the hyperparameters of a training wrong values."""
    words = [f"{rng.choice(KEYS)}:{_text(rng.choice(NASTY))}" for _ in range(rng.choice((1, 1, 2)))]
    return ["train", "--env", "OwnBit-v0", "-n", "50", "--eval-freq", "-1", "-params", *words]


def env_arguments(rng: random.Random, folder: Path) -> list[str]:
    """Give an environment wrong arguments."""
    key = rng.choice(("episode_length", "render_mode", "preset", "n_robots", "world", "x", "--x", "observation"))
    env = rng.choice(("OwnBit-v0", "OwnBit-v0", "QuadSwarm-v0"))
    word = f"{key}:{_text(rng.choice(NASTY))}"
    return ["train", "--env", env, "-n", "50", "--eval-freq", "-1", "--env-kwargs", word]


def recipe(rng: random.Random, folder: Path) -> list[str]:
    """Write a recipe with wrong values or wrong YAML."""
    values = {**RECIPE, rng.choice(KEYS): rng.choice(NASTY)}
    text = yaml.dump({"OwnBit-v0": values})
    if rng.random() < 0.4:
        text = rng.choice(
            (
                text[: rng.randrange(len(text))],
                yaml.safe_dump({"OwnBit-v0": RECIPE}) + f"  {rng.choice(KEYS)}: {_text(rng.choice(NASTY))}\n",
                _text(rng.choice(NASTY)),
                f"OwnBit-v0: {_text(rng.choice(NASTY))}",
            )
        )
    (folder / "r.yml").write_text(text, errors="surrogateescape")
    return ["train", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "-1"]


def options(rng: random.Random, folder: Path) -> list[str]:
    """Give options wrong values."""
    words = [rng.choice(OPTIONS)]
    if rng.random() < 0.9:
        words.append(_text(rng.choice(NASTY)))
    start = rng.choice(
        (["train", "--env", "OwnBit-v0"], ["tune", "--env", "OwnBit-v0"], ["enjoy", "--env", "OwnBit-v0"])
    )
    return [*start, *words]


def worlds(rng: random.Random, folder: Path) -> list[str]:
    """Fly in wrong worlds."""
    words = [f"{rng.choice(WORLD)}={_text(rng.choice(NASTY))}" for _ in range(rng.choice((1, 1, 2)))]
    return ["evaluate", "--policy", "none", "--episodes", "1", "--scenario", "random", "--world", *words]


def policies(rng: random.Random, folder: Path) -> list[str]:
    """Fly with wrong policies."""
    words = [rng.choice((*POLICIES, _text(rng.choice(NASTY)))) for _ in range(rng.choice((1, 2)))]
    return [rng.choice(("evaluate", "replay")), "--scenario", "random", "--policy", *words]


def _mutated(values: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    key = rng.choice(("env_wrapper", "vec_env_wrapper", "env_kwargs", "frame_stack", "normalize", *KEYS[:20]))
    return {**values, key: rng.choice(NASTY)}


def run_folders(rng: random.Random, folder: Path) -> list[str]:
    """Show the run of someone else whose settings are wrong."""
    name = rng.choice(("config.yml", "args.yml"))
    path = folder / "logs/maddpg/OwnBit-v0_1/OwnBit-v0" / name
    values = yaml.load(path.read_bytes(), RunLoader)
    text = yaml.dump(_mutated(dict(values), rng))
    if rng.random() < 0.2:
        text = rng.choice((text[: rng.randrange(len(text))], _text(rng.choice(NASTY))))
    path.write_text(text, errors="surrogateescape")
    command = rng.choice(("enjoy", "record"))
    return [command, "--env", "OwnBit-v0", "-n", "20", *(["--no-render"] if command == "enjoy" else [])]


def resumed_runs(rng: random.Random, folder: Path) -> list[str]:
    """Resume the run of someone else whose options or recipe are wrong."""
    path = folder / "logs/maddpg/OwnBit-v0_1/OwnBit-v0" / rng.choice(("config.yml", "args.yml"))
    values = dict(yaml.load(path.read_bytes(), RunLoader))
    text = yaml.dump(_mutated(values, rng))
    if rng.random() < 0.2:
        text = rng.choice((text[: rng.randrange(len(text))], _text(rng.choice(NASTY))))
    path.write_text(text, errors="surrogateescape")
    words = rng.choice((parameters, env_arguments, options))(rng, folder)[3:] if rng.random() < 0.3 else []
    return ["train", "--resume", str(path.parents[1]), *words]


KINDS: tuple[Callable[[random.Random, Path], list[str]], ...] = (
    *(parameters, env_arguments, recipe, options, worlds, policies, run_folders, resumed_runs),
)


def _accept(*args: Any, **kwargs: Any) -> Any:
    raise AcceptedError


def attempt(words: list[str]) -> tuple[str, str]:
    """Give a command.

    :return: "accepted", "usage", "one line" or the kind of failure, and what was printed
    """

    def late(*_: Any) -> None:
        raise TimeoutError("it hangs")

    out, err = io.StringIO(), io.StringIO()
    signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            status: Any = command_line(words)
    except AcceptedError:
        return "accepted", ""
    except SystemExit as stopped:
        told = out.getvalue() + err.getvalue()
        return ("usage" if "usage:" in told or ": error: " in told else "exit"), f"{stopped}"
    except BaseException:
        return "raw error", traceback.format_exc()[-600:]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    lines = [line for line in err.getvalue().splitlines() if line.startswith("error:")]
    usage = [line for line in err.getvalue().splitlines() if line.startswith("sb3-maddpg") and ": error: " in line]
    told = err.getvalue()
    if status == 0:
        return "accepted", ""
    if "it hangs" in told or "Traceback" in told:
        return "raw error", told[-600:]
    if usage:
        return ("usage" if len(usage) == 1 else "several lines"), told[-600:]
    after = told[told.index("error:") :].strip().splitlines() if lines else []
    return ("one line" if len(after) == 1 else "several lines"), told[-600:]


def prepare(folder: Path) -> None:
    """Train a run, stop another one with a checkpoint, and lay the traps."""
    os.chdir(folder)
    Path("lurking.py").write_text(TRAP)
    (folder.parent / "victim").mkdir()
    words = [
        "train",
        "--env",
        "OwnBit-v0",
        "-n",
        "60",
        "--eval-freq",
        "-1",
        "--verbose",
        "0",
        "--checkpoint-every",
        "50",
    ]
    with contextlib.redirect_stdout(io.StringIO()), patch("shutil.rmtree"):  # keeps the checkpoints
        assert (
            command_line([*words, "--checkpoint-every", "50", "-params", "learning_starts:20", "buffer_size:500"]) == 0
        )
        evaluate = ["evaluate", "--policy", "none", "--episodes", "1", "--scenario", "random"]
        assert command_line(evaluate) == 0  # compiles the planner


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=[one.__name__ for one in KINDS], help="default: all")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    kinds = [one for one in KINDS if args.kinds is None or one.__name__ in args.kinds]
    path = args.json.absolute() if args.json else None
    rng, tally, wrong = random.Random(args.seed), Counter[tuple[str, str]](), []
    with tempfile.TemporaryDirectory() as name, patch.object(sys, "dont_write_bytecode", True):
        folder, kept, start = Path(name).resolve() / "here", Path(name).resolve() / "kept", Path.cwd()
        folder.mkdir()
        prepare(folder)
        shutil.copytree(folder, kept)
        recorder = Recorder(folder)
        flies = (patch.object(evaluation, "fly_all", _accept), patch("quad_swarm.figures.replay.replay_page", _accept))
        trains = (
            patch.object(training.Training, "learn", _accept),
            patch.object(study.Search, "run", _accept),
            patch.object(training, "train_seeds", _accept),
            patch.object(study, "search", _accept),
        )
        with contextlib.ExitStack() as stack:
            for one in (*flies, *trains):
                stack.enter_context(one)
            for _ in tqdm(range(args.count), disable=not sys.stderr.isatty()):
                kind = rng.choice(kinds)
                shutil.rmtree(folder / "logs")
                shutil.copytree(kept / "logs", folder / "logs")
                words = [word.replace("\0", "") for word in kind(rng, folder)]
                with recorder.listening() as caught:
                    outcome, told = attempt(words)
                caught = [one for one in caught if "SB3-" not in one]
                if (folder / "caught").exists() and "lurking" not in " ".join(words).split("--gym-packages")[-1][:9]:
                    outcome = "ran code"
                (folder / "caught").unlink(missing_ok=True)
                sys.modules.pop("lurking", None)
                if caught:
                    outcome, told = "forbidden", f"{caught[:5]} {told}"
                tally[kind.__name__, outcome] += 1
                if outcome not in ("accepted", "usage", "one line"):
                    wrong.append({"kind": kind.__name__, "words": words, "outcome": outcome, "error": told})
                    print(f"{kind.__name__} {str(words)[:300]}: {outcome} {told}")
        os.chdir(start)
    outcomes = sorted({outcome for _, outcome in tally})
    for kind_name in sorted({key[0] for key in tally}):
        print(f"{kind_name:18}", *(f"{outcome} {tally[kind_name, outcome]:5}" for outcome in outcomes))
    print(f"{args.count} commands: {len(wrong)} failures")
    if path:
        rows = [{"kind": k, "outcome": o, "count": count} for (k, o), count in sorted(tally.items())]
        write_rows(path, [*rows, *wrong])
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
