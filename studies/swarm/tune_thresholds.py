"""Tune the thresholds of trained models: find the highest with which a model is as safe as full communication.

``python -m studies.swarm.tune_thresholds [MODEL.zip ...] [--scenario ...] [--n-robots ...] [--json F] [--write]`` uses
the validation set, like the tuning of rules, and the world of each model's training. In each scenario, thresholds are
tried in decreasing order, in stages of more and more episodes, until the model is as safe as full communication
(`Standard`) with a reserve (`has_reserve`), since the first threshold that passes would benefit from luck in these
episodes. With ``--n-robots``, other thresholds are tried (`TEAM_THRESHOLDS`). ``--write`` writes the smallest of these
thresholds, with which the model is safe everywhere, into its file. JSON: one row per model, scenario and threshold with
the keys of `summarise` over the episodes flown, and model, threshold, preset, scenario, safe. Rows of other models,
scenarios and teams stay, and count for a model's threshold.
"""

from __future__ import annotations

import functools
import itertools

from quad_swarm.evaluation.command import workers
from quad_swarm.evaluation.evaluation import Rows, summarise
from quad_swarm.evaluation.inference import Comparison
from quad_swarm.world.scenarios import SCENARIOS, without_obstacles
from sb3_maddpg import MADDPG
from studies.swarm.experiment import Experiment, Row, absolute_path, command_line
from studies.swarm.protocol import OF_PRESET, OF_TEAM, in_stages, models, world

# Recipes whose threshold is free and whose team is the preset's. The faithful recipe has the paper's threshold of 0.5.
TUNED = ("paper", "dense", "ablation*")
# Criterion of safety, and the fraction of its margin by which the collision rate may exceed that of full communication:
# 16 of 12,000 episodes in a preset, two thirds of what passes the criterion, and 5 of 4,000 in teams, less than half
STANDARDS = {"preset": (OF_PRESET, 4 / 9), "team": (OF_TEAM._replace(enough=4000), 1 / 4)}
THRESHOLDS = [0.99, 0.98, 0.965, 0.95, 0.925, 0.9, 0.875, 0.85, 0.825, 0.8, 0.775, 0.75, 0.725, 0.7]
THRESHOLDS += [0.675, 0.65, 0.625, 0.6, 0.575, 0.55, 0.525, 0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15, 0.1]
# For other numbers of robots: fewer thresholds below 0.8, and lower ones for teams larger than in training
TEAM_THRESHOLDS = [*THRESHOLDS[:10], *THRESHOLDS[10::2], 0.1, 0.05, 0.02, 0.01, 0.005]


@functools.cache
def full(preset: str, scenario: str, n: int | None) -> Rows:
    """Return the statistics of full communication flown so far, to which `in_stages` appends."""
    return []


def has_reserve(comparison: Comparison, margin: float, share: float) -> bool:
    """Return whether a threshold is safe with a reserve: its excess of collisions over full communication is at most a
    fraction of the margin."""
    return comparison.only_first - comparison.only_second <= share * margin * comparison.episodes


def tune(n: int | None, scenario: str, path: str, preset: str, quick: bool) -> list[Row]:
    """Tune a model in one scenario and return its rows."""
    rival = full(preset, scenario, n)
    config = world(preset, n)
    standard, share = STANDARDS["preset" if n is None else "team"]
    table: list[Row] = []
    for threshold in THRESHOLDS if n is None else TEAM_THRESHOLDS:
        figures, safe = in_stages(f"{path}@{threshold:g}", preset, scenario, rival, quick, n, standard=standard)
        safe &= quick or has_reserve(Comparison.of(figures, rival[: len(figures)]), standard.margin, share)
        keys = {"model": path, "threshold": threshold, "preset": preset, "scenario": scenario, "safe": safe}
        table.append(keys | {"n_robots": config.n_robots} | summarise(figures, config))
        if safe:
            print(f"{path} {scenario} {config.n_robots}: {threshold:g}, {table[-1]['request_share']:.2%}", flush=True)
            break
    else:
        print(f"{path} {scenario} {config.n_robots}: no threshold is as safe as full communication", flush=True)
    return table


def preset_of(path: str) -> str:
    """Return the preset of a model's training."""
    spec = MADDPG.load(path, device="cpu").env_spec
    if spec is None:
        raise ValueError(f"{path} does not say in which world it was trained.")
    return spec["kwargs"]["preset"]


def set_threshold(path: str, table: list[Row]) -> None:
    """Write the smallest threshold of all scenarios and numbers of robots into a model's file."""
    last = {(row["scenario"], row["n_robots"]): row["threshold"] for row in table if row["model"] == path}
    model = MADDPG.load(path, device="cpu")
    model.set_threshold(min(last.values()))
    model.save(path)


def main() -> None:
    """Run the command line."""
    parser = command_line(__doc__, "fly few episodes")
    parser.add_argument("models", nargs="*", metavar="MODEL.zip", help="default: all models with a free threshold")
    parser.add_argument("--scenario", nargs="+", default=without_obstacles()[::-1], choices=list(SCENARIOS))
    parser.add_argument("--n-robots", nargs="+", type=int, default=[None], help="default: the preset's")
    parser.add_argument("--json", type=absolute_path, metavar="FILE")
    parser.add_argument("--write", action="store_true", help="write each model's threshold into its file")
    args = parser.parse_args()
    if args.quick and args.write:
        parser.error("--quick flies too few episodes to choose a threshold: leave out --write")
    paths = args.models or [path for recipe in TUNED for path in models(recipe)]
    presets = {path: preset_of(path) for path in paths}
    work = [(*cell, presets[cell[-1]], args.quick) for cell in itertools.product(args.n_robots, args.scenario, paths)]
    experiment = Experiment(args.json, "model", "scenario", "n_robots")
    with workers(args) as pool:
        experiment.run(pool, "thresholds", tune, work)
    for path in paths if args.write else ():
        set_threshold(path, experiment.rows())


if __name__ == "__main__":
    main()
