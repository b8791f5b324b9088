"""Which action spaces each library's MADDPG trains on.

``make check-peers`` installs the other libraries, trains two agents with each library's own loop and prints a table.
"yes" means that every action was in its agent's space and that the actors of both agents learned; otherwise the cell
holds the error. The README's table of libraries is based on it.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import warnings
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("ours", "agilerl", "benchmarl", "xuance")
OBS_DIM, STEPS, BATCH_SIZE = 3, 400, 32


def box(size: int) -> spaces.Box:
    """:return: continuous actions in [-1, 1]"""
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


CASES: dict[str, tuple[spaces.Space, spaces.Space]] = {
    "Box": (box(3), box(3)),
    "Discrete": (spaces.Discrete(3), spaces.Discrete(3)),
    "MultiDiscrete": (spaces.MultiDiscrete([3, 2]), spaces.MultiDiscrete([3, 2])),
    "MultiBinary": (spaces.MultiBinary(2), spaces.MultiBinary(2)),
    "Box(3) and Box(5)": (box(3), box(5)),
    "Discrete(3) and Discrete(5)": (spaces.Discrete(3), spaces.Discrete(5)),
    "Box and Discrete": (box(3), spaces.Discrete(5)),
}


class Team(ParallelEnv):
    """Two agents of different kinds and names. Each action is checked."""

    metadata = {"name": "team", "render_modes": []}  # noqa: RUF012
    render_mode = None

    def __init__(self, action_spaces: tuple[spaces.Space, spaces.Space]):
        self.possible_agents = ["first_0", "second_0"]
        self.action_spaces = dict(zip(self.possible_agents, action_spaces, strict=True))
        self.observation_spaces = {agent: box(OBS_DIM) for agent in self.possible_agents}
        self.state_space = box(2 * OBS_DIM)
        self.rng = np.random.default_rng(0)
        self.taken = 0

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def observe(self) -> dict[str, np.ndarray]:
        return {agent: self.rng.uniform(-1, 1, OBS_DIM).astype(np.float32) for agent in self.possible_agents}

    def state(self) -> np.ndarray:
        return self.rng.uniform(-1, 1, 2 * OBS_DIM).astype(np.float32)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents, self.time = list(self.possible_agents), 0
        return self.observe(), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        self.time, self.taken, rewards = self.time + 1, self.taken + 1, {}
        for agent, space in self.action_spaces.items():
            action = np.asarray(actions[agent])
            if isinstance(space, spaces.Discrete) and action.size == 1:
                action = action.reshape(())
            if not space.contains(action.astype(space.dtype)) or (action.astype(space.dtype) != action).any():
                raise AssertionError(f"{agent} got the action {action} for {space}")
            rewards[agent] = float(np.sum(action))
        over, ended = self.time == 10, dict.fromkeys(self.possible_agents, False)
        truncated = dict.fromkeys(self.possible_agents, over)
        infos: dict[str, dict] = {agent: {} for agent in self.possible_agents}
        if over:
            self.agents = []
        return self.observe(), rewards, ended, truncated, infos


def weights(networks: Iterable[th.nn.Module]) -> list[np.ndarray]:
    """:return: all weights of each network"""
    return [np.concatenate([p.detach().numpy().ravel().copy() for p in net.parameters()]) for net in networks]


def ours(env: Team) -> None:
    """Train with this library."""
    from sb3_maddpg import MADDPG

    model = MADDPG("MlpPolicy", env, learning_starts=100, batch_size=BATCH_SIZE, train_freq=4, seed=0)
    actors = [model.agent_policy(agent) for agent in env.possible_agents]
    before = weights(actors)
    model.learn(STEPS)
    check(env, before, weights(model.agent_policy(agent) for agent in env.possible_agents))


def agilerl(env: Team) -> None:
    """Train with AgileRL."""
    from agilerl.algorithms import MADDPG
    from agilerl.components.replay_buffer import ReplayBuffer
    from agilerl.training.train_multi_agent_off_policy import train_multi_agent_off_policy

    agents = env.possible_agents
    agent = MADDPG(
        [env.observation_space(name) for name in agents],
        [env.action_space(name) for name in agents],
        agent_ids=agents,
        batch_size=BATCH_SIZE,
        learn_step=4,
    )
    before = weights(agent.actors[name] for name in agents)
    train_multi_agent_off_policy(
        env, "team", "MADDPG", [agent], ReplayBuffer(10_000), max_steps=STEPS, evo_steps=STEPS, verbose=False
    )
    check(env, before, weights(agent.actors[name] for name in agents))


def xuance(env: Team) -> None:
    """Train with XuanCe."""
    import xuance as library
    import yaml

    from benchmarks.peers import common

    common.restore_pettingzoo_mpe()
    from xuance.environment import REGISTRY_MULTI_AGENT_ENV, RawMultiAgentEnv, make_envs
    from xuance.torch.agents import MADDPG_Agents

    class Adapter(RawMultiAgentEnv):
        """Its adapter of particle worlds, for any environment."""

        def __init__(self, config: Namespace):
            super().__init__()
            self.env = env
            self.agents = env.possible_agents
            self.num_agents = len(self.agents)
            self.state_space, self.observation_space = env.state_space, env.observation_spaces
            self.action_space, self.max_episode_steps = env.action_spaces, 10
            self.agent_groups = [[agent] for agent in self.agents]

        def reset(self, **kwargs: Any) -> tuple[dict, dict]:
            self.returns = dict.fromkeys(self.agents, 0.0)
            observations, infos = env.reset()
            return observations, {"infos": infos, "individual_episode_rewards": self.returns}

        def step(self, actions: dict) -> tuple[dict, dict, dict, bool, dict]:
            for agent, space in self.action_space.items():
                if isinstance(space, spaces.Box):
                    actions[agent] = np.clip(actions[agent], space.low, space.high)
            observations, rewards, ended, truncated, infos = env.step(actions)
            for agent, reward in rewards.items():
                self.returns[agent] += reward
            info = {"infos": infos, "individual_episode_rewards": self.returns}
            return observations, rewards, ended, all(truncated.values()), info

        def state(self) -> np.ndarray:
            return env.state()

        def avail_actions(self) -> None:
            return None

        def render(self, *args: Any) -> None: ...

        def close(self) -> None: ...

    REGISTRY_MULTI_AGENT_ENV["Team"] = Adapter
    configs = Path(library.__file__).parent / "configs"
    settings = yaml.safe_load((configs / "basic.yaml").read_text())
    settings |= yaml.safe_load((configs / "maddpg/mpe/simple_spread_v3.yaml").read_text())
    settings |= {
        "env_name": "Team",
        "env_id": "team",
        "env_seed": 0,
        "parallels": 1,
        "use_parameter_sharing": False,
        "buffer_size": 10_000,
        "batch_size": BATCH_SIZE,
        "start_training": 100,
        "training_frequency": 4,
        "running_steps": STEPS,
    }
    agents = MADDPG_Agents(Namespace(**settings), make_envs(Namespace(**settings)))
    before = weights(agents.policy.actor[name] for name in env.possible_agents)
    agents.train(STEPS)
    check(env, before, weights(agents.policy.actor[name] for name in env.possible_agents))


def benchmarl(env: Team) -> None:
    """Train with BenchMARL, both agents in one group, so that the critic reads both."""
    from benchmarks.peers import common

    common.restore_pettingzoo_mpe()
    from benchmarl.algorithms import MaddpgConfig
    from benchmarl.environments.pettingzoo.common import PettingZooClass
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from torchrl.envs import PettingZooWrapper

    class Task(PettingZooClass):
        """Its tasks are a fixed list of environments."""

        def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Any:
            groups = {"team": env.possible_agents}
            return lambda: PettingZooWrapper(env, group_map=groups, categorical_actions=True, device=device)

        def supports_continuous_actions(self) -> bool:
            return any(isinstance(space, spaces.Box) for space in env.action_spaces.values())

        def supports_discrete_actions(self) -> bool:
            return not self.supports_continuous_actions()

        def has_state(self) -> bool:
            return False

        def max_steps(self, env: Any) -> int:
            return 10

    globals()["Task"], Task.__qualname__ = Task, "Task"  # it pickles its task
    config = ExperimentConfig.get_from_yaml()
    for key, value in {
        "max_n_frames": STEPS,
        "off_policy_collected_frames_per_batch": 100,
        "off_policy_n_envs_per_worker": 1,
        "off_policy_n_optimizer_steps": 4,
        "off_policy_train_batch_size": BATCH_SIZE,
        "off_policy_memory_size": 10_000,
        "share_policy_params": False,
        "prefer_continuous_actions": True,
        "evaluation": False,
        "render": False,
        "loggers": [],
        "create_json": False,
        "save_folder": str(Path.cwd()),
    }.items():
        setattr(config, key, value)
    model = MlpConfig.get_from_yaml()
    experiment = Experiment(
        Task("TEAM", {}), MaddpgConfig.get_from_yaml(), model, seed=0, config=config, critic_model_config=model
    )
    policy = experiment.algorithm.get_policy_for_loss("team")
    before = weights([policy])
    experiment.run()
    check(env, before, weights([policy]))


def check(env: Team, before: list[np.ndarray], after: list[np.ndarray]) -> None:
    """
    Check that something was flown and learned.

    :raises AssertionError: if an actor is unchanged or no longer finite
    """
    assert env.taken >= STEPS, f"only {env.taken} steps were made"
    for old, new in zip(before, after, strict=True):
        assert np.isfinite(new).all(), "weights are not finite"
        assert (old != new).any(), "an actor did not learn"


def measure(library: str) -> dict[str, str]:
    """:return: for each case "yes", or the error, in the Python of the library"""
    cells = {}
    for name, action_spaces in CASES.items():
        try:
            globals()[library](Team(action_spaces))
            cells[name] = "yes"
        except Exception as error:  # whatever the library raises
            cells[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return cells


def main() -> None:
    """Print the table, or the cells of one library as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--library", choices=LIBRARIES, help="one library only, which this Python has, as JSON")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the cells as a JSON list")
    arguments = parser.parse_args()
    library = arguments.library
    if library:
        warnings.filterwarnings("ignore")
        answer = os.fdopen(os.dup(1), "w")  # below sys.stdout, which loggers may hold
        os.dup2(2, 1)
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            os.chdir(folder)
            th.set_num_threads(1)
            print(json.dumps(measure(library)), file=answer, flush=True)
            os.chdir(ROOT)
        return
    rows = []
    for name in LIBRARIES:
        python = sys.executable if name == "ours" else str(ROOT / ".bench" / name / "bin" / "python")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        command = [python, "-m", "benchmarks.peers.action_spaces", "--library", name]
        run = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, check=False)
        if run.returncode:
            sys.exit(f"{name}: {' '.join(command)}\n{run.stderr[-2000:]}")
        for case, cell in json.loads(run.stdout.splitlines()[-1]).items():
            print(f"{name:10} {case:28} {cell[:200]}", flush=True)
            rows.append({"library": name, "actions": case, "trains": cell})
    if arguments.json:
        from quad_swarm.evaluation.rows import write_rows  # the other libraries' Pythons do not have it

        write_rows(arguments.json, rows)


if __name__ == "__main__":
    main()
