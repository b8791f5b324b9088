"""MADDPG of AgileRL, see ``common``.

Agents whose names have the same part before the last underscore always share their networks; for separate networks they
are renamed. Shared networks make one step per agent. Forced: three hidden layers in the actor, layer normalisation, no
gradient clipping, constant exploration noise. After the last step of an episode, its environment wrapper returns the
first observation of the next episode, which is stored as the next observation of a step that did not terminate. The
training loop always evaluates, here once at the end.
"""

from typing import Any

import numpy as np
import torch as th
from agilerl.algorithms import MADDPG
from agilerl.components.replay_buffer import ReplayBuffer
from agilerl.training.train_multi_agent_off_policy import train_multi_agent_off_policy
from pettingzoo.utils.wrappers import BaseParallelWrapper
from torch import nn

from benchmarks.peers import common

# Its actors' outputs are in [-1, 1], twice as wide as the actions
NOISE = common.SIGMA_START + common.SIGMA_END


class Renamed(BaseParallelWrapper):
    """Rename ``agent_0`` to ``agent0``, which does not belong to a group."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.names = {agent: agent.replace("_", "") for agent in env.possible_agents}
        self.originals = {new: old for old, new in self.names.items()}
        self.possible_agents = list(self.originals)

    @property
    def agents(self) -> list[str]:
        return [self.names[agent] for agent in self.env.agents]

    def observation_space(self, agent: str) -> Any:
        return self.env.observation_space(self.originals[agent])

    def action_space(self, agent: str) -> Any:
        return self.env.action_space(self.originals[agent])

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        observations, infos = self.env.reset(seed=seed, options=options)
        return self.rename(observations), self.rename(infos)

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        values = self.env.step({self.originals[agent]: action for agent, action in actions.items()})
        observations, rewards, terminations, truncations, infos = map(self.rename, values)
        return observations, rewards, terminations, truncations, infos

    def rename(self, values: dict) -> dict:
        """Rename the keys of a dictionary."""
        return {self.names[agent]: value for agent, value in values.items()}


class Policy(nn.Module):
    """An actor and the scale of its actions."""

    def __init__(self, actor: nn.Module):
        super().__init__()
        self.actor = actor

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.actor.rescale_output_action(self.actor(obs))  # type: ignore[operator]


class AgileRL:
    """Population of one, evaluated for one episode at the end of training, which the library's loop requires."""

    first_update = common.LEARNING_STARTS

    def __init__(self, task: common.Task) -> None:
        self.task = task
        self.env = self.make_env()
        agents = self.env.possible_agents
        self.agent = MADDPG(
            [self.env.observation_space(agent) for agent in agents],
            [self.env.action_space(agent) for agent in agents],
            agent_ids=agents,
            O_U_noise=False,
            expl_noise=NOISE,
            net_config={
                "latent_dim": common.HIDDEN[-1],
                "encoder_config": {"hidden_size": list(common.HIDDEN[:1])},
                "head_config": {"hidden_size": list(common.HIDDEN[1:])},
            },
            batch_size=common.BATCH_SIZE,
            lr_actor=common.LEARNING_RATE,
            lr_critic=common.LEARNING_RATE,
            learn_step=task.train_freq,
            gamma=common.GAMMA,
            tau=common.TAU,
        )
        self.memory = ReplayBuffer(common.BUFFER_SIZE)
        self.steps = 0

    def make_env(self) -> Any:
        """Create the library's seeded environment."""
        env = common.parallel_env(self.task.env)
        env.reset(seed=self.task.seed)
        return env if self.task.shared else Renamed(env)

    def train(self, warm_up: int, clock: common.Clock) -> None:
        if warm_up:
            self.learn(warm_up)
        clock.start()
        self.learn(self.task.steps - warm_up)
        clock.stop()

    def learn(self, steps: int) -> None:
        """Run the library's own loop for more steps, in one evolution step, since each ends with an evaluation."""
        self.steps += steps
        train_multi_agent_off_policy(
            self.env,
            self.task.env,
            "MADDPG",
            [self.agent],
            self.memory,
            max_steps=self.steps,
            evo_steps=steps,
            learning_delay=common.LEARNING_STARTS,
            verbose=False,
        )

    def update(self) -> None:
        self.agent.learn(self.memory.sample(self.agent.batch_size))

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self.agent.set_training_mode(False)
        names = {agent: agent if self.task.shared else self.env.names[agent] for agent in observations}
        batch = {names[agent]: observation[None] for agent, observation in observations.items()}
        actions, _ = self.agent.get_action(batch)
        return {agent: actions[name][0] for agent, name in names.items()}

    def network(self, agent: str) -> nn.Module:
        self.agent.set_training_mode(False)
        return Policy(self.agent.actors[agent.replace("_", "")])


if __name__ == "__main__":
    common.main("AgileRL", "agilerl", AgileRL)
