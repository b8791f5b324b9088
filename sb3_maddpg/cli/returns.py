"""``sb3-maddpg evaluate`` in an environment without a command of its own: returns of the team and its agents."""

from __future__ import annotations

import argparse
import csv
import json
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from tqdm import tqdm

from sb3_maddpg.cli.algorithms import ALGORITHMS, SINGLE_AGENT, algorithm
from sb3_maddpg.cli.environments import STATISTICS, Environments, find_environment
from sb3_maddpg.cli.options import PROG, StoreValues, check_writable, files_beside, integer
from sb3_maddpg.cli.overview import load_environments
from sb3_maddpg.cli.parameter_sharing import shares_parameters
from sb3_maddpg.cli.parser import Parser
from sb3_maddpg.cli.recipe import check_env_kwargs
from sb3_maddpg.cli.runs import model_path, name_of
from sb3_maddpg.cli.show import load_model, run_settings
from sb3_maddpg.cli.terminal import aligned
from sb3_maddpg.common.evaluation import Episode, compare, play, summarise
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError, TeamError
from sb3_maddpg.utils import did_you_mean, shown

RANDOM = "random"
EXAMPLES = f"""\
  {PROG} evaluate --env mpe2/simple_spread_v3 --policy latest:logs random
  {PROG} evaluate --env my_env_v0 --policy a.zip matd3:b.zip ppo:c.zip --episodes 500 --json r.json --plot plots"""


class Policy(NamedTuple):
    """A policy on the command line."""

    name: str
    """The word, by which it is called in tables"""
    algo: str
    path: Path | None
    """A model's file, None for random actions"""


def make_parser() -> Parser:
    """:return: the parser of the options"""
    parser = Parser(
        prog=f"{PROG} evaluate",
        usage=f"{PROG} evaluate --env ENV --policy POLICY ... [options]",
        description="Compare policies over the same episodes: returns of the team and of each agent.",
        epilog=f"examples:\n{EXAMPLES}",
    )
    add = parser.add_argument
    add(
        "--policy",
        nargs="+",
        action="extend",
        required=True,
        metavar="POLICY",
        help=f"MODEL.zip or latest:LOGDIR, of --algo or with another one before it, as in ppo:MODEL.zip; or {RANDOM}. "
        "The first one is what the others are compared with",
    )
    add("--episodes", type=integer(1), default=100, metavar="N", help="number of episodes (default %(default)s)")
    add("--seed", type=integer(0), default=0, metavar="N", help="seed of the first episode (default %(default)s)")
    add(
        "--env-kwargs",
        nargs="+",
        action=StoreValues,
        metavar="KEY:VALUE",
        help="arguments of the environment, merged over those of each model's training",
    )
    add("--stochastic", action="store_true", help="sample actions, or add noise, as during training")
    add("--json", metavar="FILE", help="write means and intervals; - for the standard output")
    add("--csv", metavar="FILE", help="write the episodes")
    add("--plot", type=Path, metavar="FOLDER", help="draw the returns")
    parser.rare("--device", default="cpu", help="PyTorch's device (default %(default)s)")
    return parser


def run(args: argparse.Namespace, words: list[str]) -> int:
    """
    Evaluate policies.

    :param args: the options that all commands have
    :param words: all other words
    :return: exit status
    """
    options = make_parser().parse_args(words)
    load_environments()
    env_id = find_environment(args.env)
    policies = [_policy(word, args.algo, env_id) for word in options.policy]
    if twice := [one for one in options.policy if options.policy.count(one) > 1]:
        raise InvalidArgumentError(f"--policy names {twice[0]} twice.")
    if options.plot is not None:
        if options.plot.exists() and not options.plot.is_dir():
            raise InvalidArgumentError(f"--plot {options.plot} is a file: name a folder.")
        from sb3_maddpg.cli import plots  # noqa: F401  # which needs the extra 'plot'
    for path in (options.json, options.csv):
        if path not in (None, "-"):
            check_writable(Path(path))
    th.set_num_threads(1)
    prepared = [_prepare(one, env_id, options) for one in policies]
    given = next((kwargs for one, (_, _, kwargs) in zip(policies, prepared, strict=True) if one.path), None)
    flown_in = {
        one.name: kwargs if one.path is not None or given is None else given
        for one, (_, _, kwargs) in zip(policies, prepared, strict=True)
    }
    if len({shown(kwargs, 1000) for kwargs in flown_in.values()}) > 1:
        told = ", ".join(f"{name} with {shown(kwargs, 100)}" for name, kwargs in flown_in.items())
        print(
            f"The policies act in environments that differ, so that returns do not compare: {told} (those of their "
            "trainings). Set them for all with --env-kwargs.",
            file=sys.stderr,
        )
    played: dict[str, list[Episode]] = {}
    with tqdm(total=len(policies) * options.episodes, disable=None, leave=False, unit="episode") as bar:
        for one, (settings, statistics, _) in zip(policies, prepared, strict=True):
            own = flown_in[one.name]
            played[one.name] = []
            with closing(_environment(env_id, settings, statistics, own, options.seed)) as env:
                model = None if one.path is None else _load(one, env_id, env, settings, options)
                for episode in play(model, env, options.episodes, options.seed, not options.stochastic):
                    played[one.name].append(episode)
                    bar.update()
    rival, files = played[policies[0].name], {one.name: one.path for one in policies}
    rows = [
        _row(name, files[name], env_id, flown_in[name], options.seed, episodes, rival)
        for name, episodes in played.items()
    ]
    print(tables(rows), file=sys.stderr if options.json == "-" else sys.stdout)
    if options.json is not None:
        _write_json(options.json, rows)
    if options.csv is not None:
        _write_csv(options.csv, played)
    if options.plot is not None:
        from sb3_maddpg.cli.plots import draw_returns

        print(f"wrote {draw_returns(rows, options.plot)}", file=sys.stderr)
    return 0


def _policy(word: str, algo: str, env_id: str) -> Policy:
    if word == RANDOM:
        return Policy(word, algo, None)
    prefix, colon, rest = word.partition(":")
    name = rest if colon and prefix in ALGORITHMS | SINGLE_AGENT else word
    own = prefix if name is not word else algo
    path = Path(model_path(name, own, env_id))
    if not path.is_file():
        raise FileNotFoundError(
            f"There is no file {shown(str(path))}. A policy is MODEL.zip, latest:LOGDIR or {RANDOM}."
            f"{did_you_mean(word, [RANDOM, *files_beside(str(path), '*.zip')])}"
        )
    return Policy(word, own, path)


def _prepare(
    policy: Policy, env_id: str, options: argparse.Namespace
) -> tuple[dict[str, Any], Path | None, dict[str, Any]]:
    """:return: settings of the model's run, the statistics of its normalisation, and the environment's arguments"""
    given = options.env_kwargs or {}
    if policy.path is None:
        check_env_kwargs(env_id, given)
        return {}, None, given
    run = policy.path.parent
    settings, kwargs = run_settings(run, env_id, given)
    check_env_kwargs(env_id, kwargs)
    statistics = run / name_of(env_id) / STATISTICS
    if not settings.get("normalize") or statistics.exists():
        return settings, statistics if settings.get("normalize") else None, kwargs
    if policy.algo not in ALGORITHMS:  # whose files hold the statistics
        raise InvalidFileError(
            f"{statistics} is missing: the run of {policy.name} normalises its observations with it."
        )
    return settings, None, kwargs


def _environment(
    env_id: str, settings: Mapping[str, Any], statistics: Path | None, env_kwargs: Mapping[str, Any], seed: int
) -> VecEnv:
    """:return: one environment as in the model's training; the model normalises if its statistics are in its file"""
    kept = {key: value for key, value in settings.items() if key != "normalize" or statistics is not None}
    return Environments(env_id, seed, kept).make(1, env_kwargs, evaluates=True, statistics=statistics)


def _load(policy: Policy, env_id: str, env: VecEnv, settings: Mapping[str, Any], options: argparse.Namespace) -> Any:
    assert policy.path is not None
    cls = algorithm(policy.algo)
    set_random_seed(options.seed)
    shares = shares_parameters(cls, env_id)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* was trained with VecNormalize")  # as `_Normalising` does
        try:
            model = load_model(cls, policy.path, shares, env, settings, options.seed, options.device)
        except TeamError:
            raise
        except Exception as error:  # SB3 does not check whose file it loads
            raise InvalidFileError(
                f"{policy.path} is no model of {cls.__name__} ({shown(str(error), 200)}): pass it as ALGO:MODEL.zip "
                "with the algorithm that trained it, such as maddpg."
            ) from error
    if isinstance(model, TeamAlgorithm):
        _check_team(policy, model, env)
    alone = isinstance(model, TeamAlgorithm) and model.normalized_observations and unwrap_vec_normalize(env) is None
    return _Normalising(model) if alone else model


def _check_team(policy: Policy, model: TeamAlgorithm, env: VecEnv) -> None:
    """:raises ValueError: if a model belongs to another team than an environment's"""
    seen = (model.observation_space.shape, env.observation_space.shape), (model.action_space, env.action_space)
    if any(own != other for own, other in seen):
        trained = (model.env_spec or {}).get("id", "another environment")
        raise InvalidArgumentError(
            f"{policy.name} was trained in {trained}, for a team that observes {model.observation_space} and acts in "
            f"{model.action_space}; here a team observes {env.observation_space} and acts in {env.action_space}. Pass "
            "the --env and --env-kwargs of its training."
        )


class _Normalising:
    """A model that normalises the team's observations itself, with the statistics in its file."""

    def __init__(self, model: TeamAlgorithm):
        self.model, self.statistics = model, model.statistics_of_agents()

    def predict(self, observation: np.ndarray, **options: Any) -> tuple[np.ndarray, Any]:
        if self.statistics is not None:
            observation = self.statistics.normalize(observation)
        return self.model.predict(observation, **options)


def _row(
    name: str,
    path: Path | None,
    env_id: str,
    env_kwargs: Mapping[str, Any],
    seed: int,
    episodes: Sequence[Episode],
    rival: Sequence[Episode],
) -> dict[str, Any]:
    row = {
        "policy": name,
        "model": None if path is None else str(path),
        "env": env_id,
        "env_kwargs": dict(env_kwargs),
        "seed": seed,
        **summarise(episodes),
    }
    return row if rival is episodes else row | {"difference": compare(episodes, rival)}


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """
    :param rows: what ``run`` writes as JSON
    :return: the team's figures by policy, and the returns of the agents, who are rows
    """
    successes, compared = any("success_rate" in row for row in rows), len(rows) > 1
    lines = [
        ["policy", "return", "95 % interval", *["minus the first's"] * compared, "steps", *["success"] * successes]
    ]
    for row in rows:
        difference = row.get("difference")
        lines.append(
            [
                row["policy"],
                f"{row['return']['mean']:.3f}",
                _interval(row["return"]),
                *[("" if difference is None else f"{difference['mean']:+.3f} {_interval(difference, '+')}")] * compared,
                f"{row['length']['mean']:.1f}",
                *[f"{row['success_rate']['mean']:.1%}" if "success_rate" in row else "-"] * successes,
            ]
        )
    names = list(rows[0]["agents"])
    unequal = any(len({one["length"]["mean"] for one in row["agents"].values()}) > 1 for row in rows)
    agents = [["agent", *(f"return, {row['policy']}" for row in rows)]]
    if unequal:
        agents[0] += [f"steps, {row['policy']}" for row in rows]
    for name in names:
        figures = [row["agents"][name] for row in rows]
        agents.append([name, *(f"{one['return']['mean']:.3f} {_interval(one['return'])}" for one in figures)])
        if unequal:
            agents[-1] += [f"{one['length']['mean']:.1f}" for one in figures]
    episodes = f"{rows[0]['episodes']} episodes of {rows[0]['env']} from seed {rows[0]['seed']}"
    rewards = "return: of the team, as step() rewards it (in PettingZoo environments the mean over the agents)"
    return f"{aligned(lines)}\n\n{aligned(agents)}\n\n{episodes}; {rewards}, not discounted"


def _interval(figure: Mapping[str, Any], sign: str = "") -> str:
    return "" if figure["low"] is None else f"[{figure['low']:{sign}.3f}, {figure['high']:{sign}.3f}]"


def _write_json(path: str, rows: Sequence[Mapping[str, Any]]) -> None:
    text = json.dumps(rows, indent=1)
    if path == "-":
        print(text)
    else:
        Path(path).write_text(text + "\n")


def _write_csv(path: str, played: Mapping[str, Sequence[Episode]]) -> None:
    names = list(next(iter(played.values()))[0].returns)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        titles = [f"{what}_{name}" for what in ("return", "length") for name in names]
        writer.writerow(["policy", "seed", "return", "length", "success", *titles])
        for policy, episodes in played.items():
            for one in episodes:
                success = "" if one.success is None else int(one.success)
                agents = [*one.returns.values(), *one.lives.values()]
                writer.writerow([policy, one.seed, one.team_return, one.length, success, *agents])
