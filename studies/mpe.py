"""Train with the packaged recipes in the particle worlds of Lowe et al. (2017).

``python -m studies.mpe [--envs simple_spread simple_spread:discrete ...] [--algos maddpg matd3] [--seeds 0 1 2]``
runs ``sb3-maddpg train`` for each environment, algorithm and seed, with an evaluation of 100 episodes without noise
every 10,000 steps. It adds the learning curves to studies/data/mpe2.json. Finished runs in ``--log-folder`` that
used the current recipe are not repeated. Actions are continuous, except for environments followed by ``:discrete``.
``ppo`` is PPO with one policy for all agents; its recipes have discrete actions.

Returns are means over the agents, as in the zoo's evaluation. With opponents (tag, adversary), the mean is not
informative, since all agents learn. Therefore each run also has the returns of the individual agents with the last
policy, ``agents``.
"""

import argparse
import importlib
import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import numpy as np
import yaml
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from quad_swarm.figures.colours import RULES, STYLE, colour_of
from sb3_maddpg import IDDPG, MADDPG, MASAC, MATD3
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.team.pettingzoo import TeamEnv
from studies.learning import ROOT, interval, welch

MODULES = {
    "simple_spread": "mpe2/simple_spread_v3",
    "simple_speaker_listener": "mpe2/simple_speaker_listener_v4",
    "simple_tag": "mpe2/simple_tag_v3",
    "simple_adversary": "mpe2/simple_adversary_v3",
}
ENVS = (*MODULES, "simple_spread:discrete")
ALGOS: dict[str, type[TeamAlgorithm]] = {"maddpg": MADDPG, "matd3": MATD3, "masac": MASAC, "iddpg": IDDPG}
OPPONENTS = {MODULES["simple_tag"], MODULES["simple_adversary"]}
EVAL_FREQ, EVAL_EPISODES = 10_000, 100
SHOWN = (50_000, 100_000, 500_000)
PACKAGES = ("sb3-maddpg", "stable-baselines3", "rl_zoo3", "torch", "numpy", "gymnasium", "pettingzoo", "mpe2")

KEYS = ("env", "actions", "algo", "seed")  # identify a run
Row = dict[str, Any]


class Run(NamedTuple):
    """One training."""

    env: str
    algo: str
    actions: str
    seed: int
    steps: int
    log_folder: Path

    @property
    def folder(self) -> Path:
        """Log folder of this training."""
        return self.log_folder / f"{self.env}-{self.actions}-{self.algo}-seed{self.seed}"

    @property
    def continuous(self) -> bool:
        """Whether actions are continuous."""
        return self.actions == "continuous"

    @property
    def counted(self) -> int:
        """Number of timesteps counted per environment step: PPO counts one per agent."""
        return len(_team(self).agent_names) if self.algo == "ppo" else 1

    @property
    def command(self) -> list[str]:
        """Command line after ``python``, without the log folder."""
        command = ["-m", "sb3_maddpg", "train", "--algo", self.algo, "--env", MODULES[self.env]]
        command += ["--seed", str(self.seed), "-n", str(self.counted * self.steps)]
        command += ["--eval-freq", str(self.counted * EVAL_FREQ)]
        command += ["--eval-episodes", str(EVAL_EPISODES), "--log-interval", "-2"]
        return command if self.continuous else [*command, "--env-kwargs", "continuous_actions:False"]

    def finished(self) -> Path | None:
        """:return: folder of the finished training with the current recipe, None if there is none"""
        name = MODULES[self.env].replace("/", "-")
        recipe = _recipe(self.algo, MODULES[self.env])
        recipe["env_kwargs"] = {**recipe["env_kwargs"], "continuous_actions": self.continuous}
        beside = {"eval_env_kwargs"} | ({"estimator", "temperature"} if self.continuous else set())
        for folder in sorted((self.folder / self.algo).glob(f"{name}_*")):
            model, curve, config = (folder / part for part in (f"{name}.zip", "evaluations.npz", f"{name}/config.yml"))
            if not (model.exists() and curve.exists() and config.exists()):
                continue
            # rl_zoo3 writes an OrderedDict. The file is our own, so the unsafe loader is safe here.
            trained_by = yaml.load(config.read_text(), yaml.UnsafeLoader)
            if any(trained_by.get(key) != recipe.get(key) for key in (trained_by.keys() | recipe.keys()) - beside):
                continue
            results = np.load(curve)["results"]
            if results.shape == (self.steps // EVAL_FREQ, EVAL_EPISODES * self.counted):
                return folder
        return None

    def train(self) -> None:
        """
        Train, unless the training is finished.

        :raises RuntimeError: if the training failed
        """
        if self.finished():
            print(f"{self.label}: already finished", flush=True)
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "commit").write_text(_commit())
        began = time.perf_counter()
        with (self.folder / "train.log").open("w") as log:
            environment = {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", **os.environ}
            command = [sys.executable, *self.command, "--log-folder", str(self.folder)]
            code = subprocess.run(command, cwd=ROOT, env=environment, stdout=log, stderr=log, check=False).returncode
        if code or not (folder := self.finished()):
            raise RuntimeError(f"{self.label} ended with status {code}, see {log.name}")
        last = np.load(folder / "evaluations.npz")["results"][-1].mean()
        print(f"{self.label}: {last:.2f} after {time.perf_counter() - began:.0f} s", flush=True)

    @property
    def label(self) -> str:
        """Name of the training in messages."""
        return f"{self.env} {self.actions} {self.algo} seed {self.seed}"

    def row(self) -> Row | None:
        """:return: the row of the training, None if it is not finished"""
        folder = self.finished()
        if folder is None:
            return None
        evaluations = np.load(folder / "evaluations.npz")
        agents = folder / "agents.json"
        if self.algo == "ppo":  # a single-agent policy, which returns_by_agent cannot run
            agents.write_text("{}")
        if not agents.exists():
            returns = returns_by_agent(next(folder.glob("mpe2-*.zip")), self)
            agents.write_text(json.dumps(returns))
        return {
            "env": MODULES[self.env],
            "actions": self.actions,
            "algo": self.algo,
            "seed": self.seed,
            "timesteps": list(range(EVAL_FREQ, self.steps + 1, EVAL_FREQ)),
            "mean_return": evaluations["results"].mean(axis=1).round(4).tolist(),
            "agents": json.loads(agents.read_text()),
            "command": " ".join(["python", *self.command]),
            "commit": (self.folder / "commit").read_text(),
        }


def _recipe(algo: str, env_id: str) -> Row:
    return yaml.safe_load((ROOT / "zoo_configs" / f"{algo}.yml").read_text())[env_id]


def _team(run: Run) -> TeamEnv:
    return parallel.make(MODULES[run.env].replace("/", "."), continuous_actions=run.continuous)


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def returns_by_agent(model: Path, run: Run) -> dict[str, float]:
    """
    :param model: path of a trained model
    :param run: its training
    :return: each agent's mean return over ``EVAL_EPISODES`` episodes without noise
    """
    team = _team(run)
    policy = ALGOS[run.algo].load(model, device="cpu")
    totals = np.zeros(len(team.agent_names))
    for episode in range(EVAL_EPISODES):
        obs, _ = team.reset(seed=EVAL_EPISODES * (run.seed + 1000) + episode)
        over = False
        while not over:
            action, _ = policy.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = team.step(action)
            totals += info["agent_rewards"]
            over = terminated or truncated
    team.close()
    return dict(zip(team.agent_names, (totals / EVAL_EPISODES).round(3).tolist(), strict=True))


def grouped(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """:return: rows of all seeds by environment, kind of actions and algorithm"""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["env"], row["actions"], row["algo"]), []).append(row)
    return groups


def report(rows: Sequence[Row]) -> None:
    """Print the table, and how MADDPG compares with each other algorithm at the end."""
    shown = [at for at in SHOWN if any(at in row["timesteps"] for row in rows)]
    print(f"\nReturn, mean over the agents, of the policy without noise ({EVAL_EPISODES} episodes); 95 % t-interval.")
    print(f"{'environment':32} {'actions':11} {'algorithm':9} {'seeds':>5}" + "".join(f"{at:>24,}" for at in shown))
    for (env, actions, algo), seeds in grouped(rows).items():
        line = f"{env:32} {actions:11} {algo:9} {len(seeds):5}"
        for at in shown:
            values = [row["mean_return"][row["timesteps"].index(at)] for row in seeds if at in row["timesteps"]]
            line += f"{'{:.2f} ± {:.2f}'.format(*interval(values)) if values else '-':>24}"
        print(line)
        if last := {name: [row["agents"][name] for row in seeds] for name in seeds[0]["agents"]}:
            print("    at the end: " + ", ".join(f"{name} {mean(values):.2f}" for name, values in last.items()))
    found = comparisons(rows)
    corrected = holm([one[2] for one in found.values()])
    if found:
        print("\nMADDPG minus another algorithm at the end, Welch's 95 % interval; p by Holm too.")
    for ((env, actions, algo), (difference, half, p)), after in zip(found.items(), corrected, strict=True):
        print(f"  {env:32} {actions:11} {algo:9} {difference:+.2f} ± {half:.2f}   p = {p:.3f}, corrected {after:.3f}")


def comparisons(rows: Iterable[Row]) -> dict[tuple[str, str, str], tuple[float, float, float]]:
    """
    :return: difference of the last mean returns, half-width of its interval, and p of Welch's test, of MADDPG and each
        other algorithm; without opponents, whose mean return says nothing
    """
    groups = grouped(row for row in rows if row["env"] not in OPPONENTS)
    last = {group: [row["mean_return"][-1] for row in seeds] for group, seeds in groups.items()}
    return {
        (env, actions, algo): (*welch(own, values), float(stats.ttest_ind(own, values, equal_var=False).pvalue))
        for (env, actions, algo), values in last.items()
        if algo != "maddpg" and (own := last.get((env, actions, "maddpg"))) and min(len(own), len(values)) > 1
    }


def holm(p_values: Sequence[float]) -> list[float]:
    """
    :return: p-values corrected for their number, in the same order (Holm 1979)
    """
    order = np.argsort(p_values)
    steps = np.array(p_values)[order] * np.arange(len(order), 0, -1)
    corrected = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected[np.argsort(order)].tolist()


def random_return(env: str, actions: str) -> float:
    """
    :param env: environment as in rows, such as mpe2/simple_spread_v3
    :param actions: continuous or discrete
    :return: mean return of random actions over agents and 500 episodes
    """
    module = importlib.import_module(env.replace("/", "."))
    team_env = TeamEnv(module.parallel_env(continuous_actions=actions == "continuous"))
    team_env.action_space.seed(0)
    total = 0.0
    for seed in range(500):
        team_env.reset(seed=seed)
        ended = False
        while not ended:
            _, reward, terminated, truncated, _ = team_env.step(team_env.action_space.sample())
            total, ended = total + float(reward), terminated or truncated
    return total / 500


def plot(rows: Sequence[Row], file: Path) -> None:
    """Draw the learning curves with 95 % t-intervals and the return of random actions, with a panel for each
    environment and kind of actions; not those of opponents, whose mean says nothing."""
    groups = grouped(row for row in rows if row["env"] not in OPPONENTS)
    kinds = list(dict.fromkeys((env, actions) for env, actions, _ in groups))
    algos = [algo for algo in (*ALGOS, "ppo") if any(group[2] == algo for group in groups)]
    height = math.ceil(len(kinds) / 2)
    with rc_context(STYLE):
        figure = Figure(figsize=(8, 2.7 * height), layout="constrained")
        panels = list(figure.subplots(height, min(len(kinds), 2), squeeze=False).flat)
        for axes, kind in zip(panels, kinds, strict=False):
            for index, algo in enumerate(algos):
                if seeds := groups.get((*kind, algo)):
                    _draw_curve(axes, seeds, algo.upper(), index)
            level = random_return(*kind)
            axes.axhline(level, color=RULES, linewidth=1, linestyle=(0, (2, 2)), label="random actions")
            best = max(np.max(line.get_ydata()) for line in axes.get_lines())
            axes.set_ylim(level - 0.15 * abs(level), best + 0.1 * abs(level))
            axes.set_title("{}, {} actions".format(kind[0].removeprefix("mpe2/"), kind[1]))
            axes.set_ylabel("return, mean over agents")
            axes.set_xlabel("environment steps (thousands)")
        for axes in panels[len(kinds) :]:
            axes.set_visible(False)
        shown = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        order = sorted(shown, key=lambda label: [*(algo.upper() for algo in algos), "random actions"].index(label))
        legend = figure.legend([shown[label] for label in order], order, loc="outside lower center", ncols=len(order))
        legend.set_title("shaded: 95 % intervals of the mean over seeds")
        file.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(file)
    print(f"Figure: {file}")


def _draw_curve(axes: Axes, seeds: Sequence[Row], label: str, index: int) -> None:
    steps = np.array(seeds[0]["timesteps"]) / 1000
    curves = np.array([row["mean_return"] for row in seeds])
    middle, half = np.array([interval(values) for values in curves.T]).T
    style = ("-", "--", "-.", (0, (1, 1)), (0, (7, 2, 1, 2, 1, 2)))[index % 5]
    axes.plot(steps, middle, linestyle=style, color=colour_of(index), label=label)
    axes.fill_between(steps, middle - half, middle + half, color=colour_of(index), alpha=0.15, linewidth=0)


def write(rows: Sequence[Row], file: Path) -> None:
    """Write the results with the versions and recipes that produced them; each row names its own command."""
    about = {
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "eval_freq": EVAL_FREQ,
        "eval_episodes": EVAL_EPISODES,
        "recipes": {
            f"{algo} {env}": _recipe(algo, env)
            for env, algo in dict.fromkeys((row["env"], row["algo"]) for row in rows)
        },
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    runs = ",\n".join(f"    {json.dumps(row)}" for row in rows)
    head = json.dumps(about, indent=2).removesuffix("\n}")
    file.write_text(f'{head},\n  "runs": [\n{runs}\n  ]\n}}\n')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=ENVS, choices=[*MODULES, *(f"{env}:discrete" for env in MODULES)])
    parser.add_argument("--algos", nargs="+", default=["maddpg"], choices=[*ALGOS, "ppo"])
    parser.add_argument("--seeds", nargs="+", type=int, default=range(5))
    parser.add_argument("--steps", type=int, default=100_000, help="length of each training (default 100,000)")
    parser.add_argument("--jobs", type=int, default=1, help="parallel trainings, each with one thread")
    parser.add_argument("--log-folder", type=Path, default=Path("logs/mpe2"), help="folder of the trainings")
    parser.add_argument("--json", type=Path, default=ROOT / "studies/data/mpe2.json", metavar="FILE")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the learning curves")
    parser.add_argument("--report", action="store_true", help="only report what is trained, and what --json has")
    args = parser.parse_args()

    folder = args.log_folder.resolve()
    runs = []
    for env in args.envs:
        name, _, kind = env.partition(":")
        runs += [
            Run(name, algo, kind or "continuous", seed, args.steps, folder)
            for algo in args.algos
            for seed in args.seeds
        ]
    failures = []
    if not args.report:
        with ThreadPoolExecutor(args.jobs) as pool:
            # Seed by seed, so that an early end leaves equal numbers of seeds
            for future in [pool.submit(run.train) for run in sorted(runs, key=lambda run: run.seed)]:
                try:
                    future.result()
                except RuntimeError as error:
                    failures.append(str(error))
                    print(f"FAILED {error}", flush=True)
    finished = [row for run in runs if (row := run.row())]
    trained = {tuple(row[key] for key in KEYS) for row in finished}
    known = json.loads(args.json.read_text())["runs"] if args.json.exists() else []
    rows = [*(row for row in known if tuple(row[key] for key in KEYS) not in trained), *finished]
    if not rows:
        sys.exit("Nothing is finished.")
    report(rows)
    if finished:
        write(rows, args.json)
    if args.plot:
        plot(rows, args.plot)
    if len(rows) < len(runs):
        sys.exit(f"{len(runs) - len(rows)} of {len(runs)} runs are missing.")


if __name__ == "__main__":
    main()
