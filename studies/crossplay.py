"""Cross-play: let the agents of all libraries that `studies.learning` trained play against each other.

``python -m studies.crossplay [--json F]`` after ``python -m studies.learning --peers``. In tag and adversary, one
side gains what the other loses, and both learn, so a library's return against its own agents does not show how good
they are. Here, each side of each training plays against the other side of all trainings, of its own library and the
others, in the same episodes without exploration. For each side and library:

- ``score``: mean return of an agent of that side. A training's score is the mean over the libraries of its opponents,
  which have equal weights, regardless of their numbers of trainings. Mean over trainings with a 95 % t-interval;
- ``others``: the same against other libraries only;
- ``ours_minus``: score of ours minus score of this library against the same opponents, with Welch's 95 % interval over
  the trainings of both.

Thousands of worlds are stepped at a time, as mpe2 steps a single one. The first episodes are compared with mpe2.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.peers import common
from studies.learning import EVERYTHING, FOLDER, OURS, actors_of, interval, read, sides, welch, write

COMPETITIVE = ("simple_tag_v3", "simple_adversary_v3")
EPISODES = range(10_000, 10_100)
STEPS = 25

Row = dict[str, Any]
Training = tuple[str, int, int]  # driver, seed and steps


class Worlds:
    """
    Batch of worlds of a task of mpe2, with the initial states of its seeded episodes.

    :param name: name of the task
    :param seeds: seeds of the episodes
    :param copies: number of copies of the set of episodes
    """

    def __init__(self, name: str, seeds: Sequence[int], copies: int = 1):
        env = common.parallel_env(name)
        world = env.unwrapped.world
        self.tag = name == "simple_tag_v3"
        self.agents: list[str] = env.possible_agents
        self.n_agents = len(self.agents)
        entities = world.entities
        self.accel = np.array([5.0 if agent.accel is None else agent.accel for agent in world.agents])[:, None]
        self.max_speed = np.array([np.inf if agent.max_speed is None else agent.max_speed for agent in world.agents])
        assert all(agent.mass == 1.0 and agent.silent for agent in world.agents)
        assert not any(landmark.movable for landmark in world.landmarks)
        self.world = world
        self.sizes = np.array([entity.size for entity in entities])
        self.collide = [entity.collide for entity in entities]
        starts, goals = [], []
        for seed in seeds:
            env.reset(seed=seed)
            starts.append([entity.state.p_pos.copy() for entity in entities])
            goals.append(0 if self.tag else world.landmarks.index(world.agents[0].goal_a))
        self.position = np.tile(np.array(starts), (copies, 1, 1))
        self.velocity = np.zeros_like(self.position[:, : self.n_agents])
        self.goal = self.position[np.arange(len(self.position)), self.n_agents + np.tile(goals, copies)]

    def observe(self) -> dict[str, np.ndarray]:
        """:return: each agent's observations, (worlds, obs_dim)"""
        n, landmarks = self.n_agents, range(self.n_agents, self.position.shape[1])
        observations = {}
        for i, agent in enumerate(self.agents):
            own = self.position[:, i]
            others = [other for other in range(n) if other != i]
            around = [self.position[:, entity] - own for entity in (*landmarks, *others)]
            if self.tag:
                seen = [self.velocity[:, other] for other in others if self.agents[other].startswith("agent")]
                parts = [self.velocity[:, i], own, *around, *seen]
            else:
                parts = [self.goal - own, *around] if agent.startswith("agent") else around
            observations[agent] = np.concatenate(parts, axis=1).astype(np.float32)
        return observations

    def step(self, actions: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        :param actions: each agent's actions, (worlds, 5)
        :return: each agent's rewards, (worlds,)
        """
        n, world = self.n_agents, self.world
        joint = np.stack([actions[agent] for agent in self.agents], axis=1).astype(np.float64)
        force = np.stack([joint[..., 2] - joint[..., 1], joint[..., 4] - joint[..., 3]], axis=2) * self.accel
        for a in range(n):
            for b in range(a + 1, self.position.shape[1]):
                if not (self.collide[a] and self.collide[b]):
                    continue
                delta = self.position[:, a] - self.position[:, b]
                distance = np.linalg.norm(delta, axis=1, keepdims=True)
                gap = distance - self.sizes[a] - self.sizes[b]
                penetration = np.logaddexp(0, -gap / world.contact_margin) * world.contact_margin
                push = world.contact_force * delta / distance * penetration
                force[:, a] += push
                if b < n:
                    force[:, b] -= push
        self.position[:, :n] += self.velocity * world.dt
        self.velocity = self.velocity * (1 - world.damping) + force * world.dt
        speed = np.linalg.norm(self.velocity, axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            self.velocity *= np.where(speed > self.max_speed, self.max_speed / speed, 1.0)[..., None]
        return self.rewards()

    def rewards(self) -> dict[str, np.ndarray]:
        """:return: each agent's rewards, (worlds,)"""
        hunters = [i for i, agent in enumerate(self.agents) if agent.startswith("adversary")]
        good = [i for i in range(self.n_agents) if i not in hunters]
        if self.tag:
            (prey,) = good
            distance = np.linalg.norm(self.position[:, hunters] - self.position[:, [prey]], axis=2)
            caught = 10.0 * (distance < self.sizes[hunters] + self.sizes[prey]).sum(axis=1)
            x = np.abs(self.position[:, prey])
            outside = np.where(x < 1.0, (x - 0.9) * 10, np.minimum(np.exp(np.minimum(2 * x - 2, 3)), 10))
            fine = np.where(x < 0.9, 0.0, outside).sum(axis=1)
            rewards = {i: caught for i in hunters} | {prey: -caught - fine}
        else:
            distance = np.linalg.norm(self.position[:, : self.n_agents] - self.goal[:, None], axis=2)
            team = distance[:, hunters].sum(axis=1) - distance[:, good].min(axis=1)
            rewards = {i: -distance[:, i] for i in hunters} | dict.fromkeys(good, team)
        return {agent: rewards[i] for i, agent in enumerate(self.agents)}


def check(name: str, seeds: Sequence[int]) -> None:
    """
    Compare ``Worlds`` with mpe2 for random actions or, in tag, actions that make agents meet.

    :raises AssertionError: if observations or rewards differ
    """
    worlds, rng = Worlds(name, seeds), np.random.default_rng(0)
    envs = [common.parallel_env(name) for _ in seeds]
    observed = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
    for _ in range(STEPS):
        observations = worlds.observe()
        for agent in worlds.agents:
            np.testing.assert_allclose(observations[agent], [each[agent] for each in observed], atol=1e-4)
        actions = {agent: rng.random((len(seeds), 5), np.float32) for agent in worlds.agents}
        if worlds.tag:  # all move towards the prey, which stays, to cause contacts
            for i, agent in enumerate(worlds.agents):
                x, y = (worlds.position[:, worlds.n_agents - 1] - worlds.position[:, i]).T
                actions[agent] = np.stack([0 * x, -x, x, -y, y], axis=1).clip(0, 1).astype(np.float32)
        rewards = worlds.step(actions)
        played = [env.step({agent: actions[agent][i] for agent in actions}) for i, env in enumerate(envs)]
        observed = [each[0] for each in played]
        for agent in worlds.agents:
            np.testing.assert_allclose(rewards[agent], [each[1][agent] for each in played], atol=1e-4)


def play(name: str, trainings: Sequence[Training], folder: Path, seeds: Sequence[int]) -> dict[str, np.ndarray]:
    """
    Let all trainings play against each other.

    :return: mean return of an agent of each side, ``adversary`` and ``good``, (training of the adversaries, training of
        the good agents)
    """
    count, episodes = len(trainings), len(seeds)
    worlds = Worlds(name, seeds, count * count)
    programs = {
        agent: [
            th.jit.load(str(actors_of(folder, driver, name, seed, steps) / f"{agent}.pt"))
            for driver, seed, steps in trainings
        ]
        for agent in worlds.agents
    }
    returns = dict.fromkeys(worlds.agents, 0.0 * worlds.goal[:, 0])
    for _ in range(STEPS):
        actions = {}
        for agent, observations in worlds.observe().items():
            axis = 0 if agent.startswith("adversary") else 1
            # (training of the adversaries, training of the good agents, episode, column)
            table = th.from_numpy(observations).view(count, count, episodes, -1)
            with th.no_grad():
                parts = [
                    program(table.select(axis, i).flatten(0, 1)).view(count, episodes, -1)
                    for i, program in enumerate(programs[agent])
                ]
            actions[agent] = th.stack(parts, axis).flatten(0, 2).numpy()
        for agent, reward in worlds.step(actions).items():
            returns[agent] = returns[agent] + reward
    return {
        side: np.mean([returns[agent] for agent in agents], axis=0).reshape(count, count, episodes).mean(axis=2)
        for side, agents in sides(worlds.agents).items()
    }


def summarise(name: str, trainings: Sequence[Training], scores: dict[str, np.ndarray]) -> list[Row]:
    """:return: one row per side and library"""
    drivers = sorted({driver for driver, *_ in trainings}, key=EVERYTHING.index)
    members = {driver: [i for i, (other, *_) in enumerate(trainings) if other == driver] for driver in drivers}
    rows = []
    for side, table in scores.items():
        # (training, library of its opponents)
        own_first = table if side == "adversary" else table.T
        against = np.stack([own_first[:, members[driver]].mean(axis=1) for driver in drivers], axis=1)
        every = against.mean(axis=1)
        for column, driver in enumerate(drivers):
            mine = members[driver]
            foreign = np.delete(against[mine], column, axis=1).mean(axis=1) if len(drivers) > 1 else every[mine]
            (score, half), (others, others_half) = interval(every[mine]), interval(foreign)
            row = {
                "env": name,
                "side": side,
                "driver": driver,
                "seeds": len(mine),
                "score": score,
                "interval": half,
                "others": others,
                "others_interval": others_half,
                "scores": list(every[mine]),
                "against": dict(zip(drivers, against[mine].mean(axis=0), strict=True)),
            }
            if OURS in members and driver != OURS:
                row["ours_minus"], row["ours_minus_interval"] = welch(every[members[OURS]], every[mine])
            rows.append(row)
    return rows


def report(rows: Sequence[Row]) -> None:
    """Print the scores in total and against each library."""
    for row in rows:
        if row["driver"] == rows[0]["driver"]:
            opponents = "".join(f"{name:>10}" for name in row["against"])
            labels = f"{row['env'] + ', ' + row['side']:32} seeds {'score':>8} {'+-':>6} {'others':>8} {'+-':>6}"
            print(f"\n{labels} {'ours_minus':>11} {'+-':>6}  | against{opponents}")
        cells = f"{row['driver']:32} {row['seeds']:5d} {row['score']:8.2f} {row['interval']:6.2f}"
        cells += f" {row['others']:8.2f} {row['others_interval']:6.2f}"
        difference = f"{row['ours_minus']:11.2f} {row['ours_minus_interval']:6.2f}" if "ours_minus" in row else 18 * " "
        print(f"{cells} {difference}  |        " + "".join(f"{value:10.2f}" for value in row["against"].values()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    parser.add_argument("--only", nargs="+", choices=EVERYTHING, default=EVERYTHING, help="only these libraries")
    parser.add_argument("--tasks", nargs="+", choices=COMPETITIVE, default=COMPETITIVE)
    parser.add_argument("--seeds", type=int, help="maximum number of trainings per library")
    parser.add_argument("--steps", type=int, default=50_000, help="steps of the trainings")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the trainings (default logs/learning)")
    args = parser.parse_args()

    th.set_num_threads(1)
    rows: list[Row] = []
    for name in args.tasks:
        check(name, EPISODES[:4])
        trainings: list[Training] = sorted(
            (
                (run["driver"], run["seed"], run["steps"])
                for run in read(args.folder)
                if run["env"] == name and run["steps"] == args.steps and run["driver"] in args.only
                if args.seeds is None or run["seed"] < args.seeds
            ),
            key=lambda training: (EVERYTHING.index(training[0]), training[1]),
        )
        if not trainings:
            print(f"No trainings of {name}: python -m studies.learning --peers", file=sys.stderr)
            continue
        print(f"{name}: {len(trainings)} trainings", file=sys.stderr, flush=True)
        rows += summarise(name, trainings, play(name, trainings, args.folder, EPISODES))
    report(rows)
    if args.json:
        write(args.json, rows)


if __name__ == "__main__":
    main()
