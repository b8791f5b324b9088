"""What is another robot's plan worth? References for docs/anticipation.md, by planning again with it.

``python -m studies.swarm.information evaluate ...`` is ``sb3-maddpg evaluate`` with two more rules, which no robot
could follow, since they know all plans. Robots receive the plan of another if their own plan would change by more than
``EPS`` (m) at some stage (``change:EPS``), or if theirs, made without it, costs more beside that plan than the one that
they would make with it by ``COST`` (``regret:COST``).

``python -m studies.swarm.information train --out F.zip [--target RULE] [--rounds N] [--n-robots N] [--seed S]
[--preset P] [--world NAME=VALUE ...]`` trains the actor of zoo_configs/quad_swarm_flight_v2.yml to know, by logistic
regression, which plans such a rule would send. Robots fly as the last actor sends, at first as a rule that tells, so
that it learns from its own flights.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
import yaml
from torch.nn import functional as F

from quad_swarm.planner.base import Planner, Plans
from quad_swarm.planner.cost import PlanCost
from quad_swarm.planner.problem import Problems
from quad_swarm.quadrotor import POSITION
from quad_swarm.task.request_task import RequestTask, make_task
from quad_swarm.task.rules import RULES, Rule, parse_rule
from quad_swarm.task.view import View
from quad_swarm.validation import read_assignments
from quad_swarm.world.presets import PRESETS
from quad_swarm.world.swarm import Swarm
from sb3_maddpg import MADDPG
from sb3_maddpg.cli.main import main as command
from studies.learning import ROOT
from studies.swarm.experiment import untrained

RECIPE = "zoo_configs/quad_swarm_flight_v2.yml"
# Distance between a plan and another's beyond which neither changes (m)
NEAR = 1.3
# Swarms that fly beside each other, and steps between those from which is learned
SWARMS, APART = 48, 4


class Worth(NamedTuple):
    """What the plans of the others would change, (E, n, n - 1) each.

    :param regret: how much more the robot's plan, made without the other's, costs beside it than the one made with it
    :param change: greatest distance between these two plans at the same stage (m)
    """

    regret: np.ndarray
    change: np.ndarray


_cost = functools.lru_cache(maxsize=4)(PlanCost)  # takes a second to build


def worth(view: View) -> Worth:
    """Plan once more for each pair of robots, with the other's newest plan.

    :param view: what robots of swarms know, which have their own planner
    """
    swarm = view._knowledge
    assert isinstance(swarm, Swarm)
    planner, last = swarm.planner, swarm._plans
    assert isinstance(planner, Planner)  # robots that are alike
    believed = view.prediction.believed()
    told = view.of_others(view.absolute_plans)[..., 1:, :]
    problems = swarm._problems(believed, view.prediction.remembers.astype(np.int64))
    cost, rate = _cost(planner.solver.problem), planner.rate  # type: ignore[attr-defined]
    regret, change = np.zeros(believed.shape[:3]), np.zeros(believed.shape[:3])
    try:
        planner.rate = None
        alone = planner.plan(problems, last)
        own = alone.x[:, 1:, POSITION].reshape(*believed.shape[:2], 1, *believed.shape[3:])
        gaps = [np.linalg.norm(own - theirs, axis=-1).min(axis=-1) for theirs in (believed, told)]
        pairs = np.nonzero(np.minimum(*gaps) < NEAR)
        rows = pairs[0] * believed.shape[1] + pairs[1]
        known = problems.part(rows)
        known.others[np.arange(len(rows)), pairs[2]] = told[pairs]
        if known.announced is not None:
            known.announced[np.arange(len(rows)), pairs[2]] = True
        found: list[np.ndarray] = []

        def compare(prepared: Problems, x: np.ndarray, u: np.ndarray) -> np.ndarray:
            found.append(cost(prepared, alone.x[rows], alone.u[rows]) - cost(prepared, x, u))
            return found[0]

        planner.rate = compare
        informed = planner.plan(known, Plans._make(array[rows] for array in last))
    finally:
        planner.rate = rate
    regret[pairs] = found[0]
    change[pairs] = np.linalg.norm(informed.x[..., POSITION] - alone.x[rows][..., POSITION], axis=-1).max(axis=-1)
    return Worth(regret, change)


def by_regret(cost: float) -> Rule:
    """Receive plans of which the robot would regret not to know them by more than ``cost``."""
    return lambda view: worth(view).regret > cost


def by_change(distance: float) -> Rule:
    """Receive plans with which the robot's own changes by more than ``distance`` (m)."""
    return lambda view: worth(view).change > distance


def add_rules() -> None:
    """Register both rules."""
    RULES["regret"], RULES["change"] = (by_regret, ("COST",)), (by_change, ("EPS",))


class Lesson(NamedTuple):
    """What robots saw, and what was worth knowing.

    :param obs: observations, (E, n, size)
    :param asked: whether to ask each of the others, and whether to tell it, (E, n, (n - 1) * 2) bool
    """

    obs: np.ndarray
    asked: np.ndarray


class School:
    """Swarms that fly as a rule or an actor sends, and whose robots plan again now and then.

    :ivar seen: observations of the last steps before the newest, oldest first
    :ivar age: number of steps since the episodes began, (E,)

    :param kwargs: arguments of the environment
    :param target: the rule by which plans are worth knowing, such as "change:0.2"
    :param seed: seed of the episodes
    """

    def __init__(self, kwargs: dict[str, Any], target: str, seed: int):
        self.rng, self.target = np.random.default_rng(seed), parse_rule(target)
        self.task: RequestTask = make_task(SWARMS, **kwargs)
        self.rule = parse_rule("stage:1.2:0.2")
        self.seen: deque[np.ndarray] = deque(maxlen=APART)
        self.age = np.zeros(SWARMS, dtype=np.int64)
        for swarm in range(SWARMS):
            self._begin(swarm)

    def _begin(self, swarm: int) -> None:
        self.age[swarm] = 0
        self.task.reset(swarm, np.random.default_rng(int(self.rng.integers(2**31))))

    def _bits(self, model: MADDPG | None, obs: np.ndarray) -> np.ndarray:
        shape = (*obs.shape[:2], obs.shape[1] - 1, 2)
        if model is None:
            requests = self.rule(View(self.task.swarm))
            requests &= self.rng.random((SWARMS, 1, 1)) < self.rng.random((SWARMS, 1, 1))
            return np.stack([requests, np.zeros_like(requests)], axis=-1)
        with th.no_grad():
            chance = th.sigmoid(model.actor.logits(th.as_tensor(obs))).numpy().reshape(shape)
        return chance > self.rng.uniform(0.1, 0.9, (SWARMS, 1, 1, 1))

    def lesson(self, model: MADDPG | None) -> Lesson:
        """Fly some steps, then look."""
        for _ in range(APART):
            obs = self.task.observe()
            self.seen.append(obs)
            outcome = self.task.act(self._bits(model, obs))
            self.age += 1
            for swarm in np.flatnonzero(outcome.terminated | outcome.truncated):
                self._begin(int(swarm))
        matters = self.target(View(self.task.swarm))
        told = self.task.swarm.neighbours.of_the_other(matters)
        asked = np.stack([matters, told], axis=-1)
        return Lesson(self.task.observe(), asked.reshape(*asked.shape[:2], -1))


def beginner(options: argparse.Namespace) -> tuple[MADDPG, dict[str, Any]]:
    """Return a model whose actor has not learned, and the arguments of its environment."""
    recipe = yaml.safe_load((ROOT / RECIPE).read_text())["QuadSwarm-v0"]
    observed = recipe["env_kwargs"]["observation"].removesuffix("+critic")
    kwargs = {**recipe["env_kwargs"], "preset": options.preset, "n_robots": options.n_robots, "observation": observed}
    kwargs |= {"world": read_assignments("--world", options.world), "reward": {"goal": 0, "request": 0}}
    return untrained(kwargs, recipe["policy_kwargs"], options.seed), kwargs


def train(options: argparse.Namespace) -> MADDPG:
    """Train an actor. Prints what it has learned after each round."""
    model, kwargs = beginner(options)
    school = School(kwargs, options.target, options.seed)
    optimizer = th.optim.Adam(model.actor.parameters(), lr=1e-3)
    known: list[Lesson] = []
    for number in range(options.rounds):
        known += [school.lesson(model if number else None) for _ in range(options.lessons)]
        updates = options.updates
        for k in range(updates):
            for group in optimizer.param_groups:
                group["lr"] = 1e-3 * (1 - (number * updates + k) / (options.rounds * updates))
            obs, asked = (th.as_tensor(part) for part in known[school.rng.integers(len(known))])
            chosen = th.randperm(len(obs))[:24]
            logits = model.actor.logits(obs[chosen])
            may = logits > -50.0  # what the action mask allows
            loss = F.binary_cross_entropy_with_logits(logits[may], asked[chosen][may].float())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        share = np.mean([lesson.asked.mean() for lesson in known[-options.lessons :]])
        print(f"round {number + 1}: {share:.2%} of the plans matter, loss {loss.item():.4f}", flush=True)
    return model


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Read the command line, with the options of those who learn what plans are worth.

    :param parser: the command's other options
    """
    parser.add_argument("--preset", default="flight-v3", choices=list(PRESETS), help="the world (default %(default)s)")
    parser.add_argument(
        "--world",
        nargs="*",
        default=["planner.commitment=0"],
        metavar="NAME=VALUE",
        help="fields of the world (default planner.commitment=0)",
    )
    parser.add_argument("--n-robots", type=int, default=12, help="number of robots (default %(default)s)")
    parser.add_argument("--target", default="change:0.2", help="which plans are worth knowing (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of episodes and networks (default %(default)s)")
    add_rules()
    options = parser.parse_args()
    try:
        parse_rule(options.target)
    except ValueError as error:
        parser.error(str(error))
    return options


def main() -> None:
    """Run the command line."""
    if sys.argv[1:2] == ["evaluate"]:
        add_rules()
        sys.exit(command())
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", choices=["train"])
    parser.add_argument("--out", type=Path, required=True, help="where to write the model")
    parser.add_argument("--rounds", type=int, default=6, help="rounds of flying and learning (default %(default)s)")
    parser.add_argument("--lessons", type=int, default=60, help="looks in each round (default %(default)s)")
    parser.add_argument("--updates", type=int, default=2000, help="updates in each round (default %(default)s)")
    options = parsed(parser)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    train(options).save(options.out, lean="actor")
    print(f"{options.out}: {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
