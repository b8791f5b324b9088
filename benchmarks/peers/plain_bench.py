"""MADDPG as a plain handwritten PyTorch loop, see ``common``.

It uses one ``nn.Sequential`` and one Adam per actor and critic, a loop over the agents, and a NumPy ring buffer.
"""

import copy
from itertools import pairwise

import numpy as np
import torch as th
from torch import nn

from benchmarks.peers import common


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Create a network with ReLU hidden layers."""
    widths = (inputs, *common.HIDDEN)
    layers: list[nn.Module] = [layer for pair in pairwise(widths) for layer in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


class Plain:
    """Driver with separate networks only."""

    first_update = common.LEARNING_STARTS

    def __init__(self, task: common.Task) -> None:
        if task.shared:
            raise ValueError("The plain loop supports separate networks only.")
        self.task = task
        self.env = common.parallel_env(task.env)
        self.agents: list[str] = self.env.possible_agents
        obs_dims = [self.env.observation_space(agent).shape[0] for agent in self.agents]
        action_dims = [self.env.action_space(agent).shape[0] for agent in self.agents]
        joint = sum(obs_dims) + sum(action_dims)
        self.actors = [mlp(*dims) for dims in zip(obs_dims, action_dims, strict=True)]
        self.critics = [mlp(joint, 1) for _ in self.agents]
        self.actor_targets, self.critic_targets = copy.deepcopy((self.actors, self.critics))
        self.actor_optimizers = [th.optim.Adam(net.parameters(), common.LEARNING_RATE) for net in self.actors]
        self.critic_optimizers = [th.optim.Adam(net.parameters(), common.LEARNING_RATE) for net in self.critics]
        shapes = (sum(obs_dims), sum(action_dims), sum(obs_dims), len(self.agents), len(self.agents))
        self.buffer = [np.zeros((common.BUFFER_SIZE, size), np.float32) for size in shapes]
        self.size = 0
        self.obs_splits = np.cumsum(obs_dims)[:-1]
        self.obs_dims, self.action_dims = obs_dims, action_dims
        self.rng = np.random.default_rng(task.seed)

    def train(self, warm_up: int, clock: common.Clock) -> None:
        observations, _ = self.env.reset(seed=self.task.seed)
        joint_obs = np.concatenate([observations[agent] for agent in self.agents])
        for step in range(self.task.steps):
            if step == warm_up:
                clock.start()
            sigma = common.sigma_at(step / self.task.steps)
            actions = {
                agent: np.clip(action + self.rng.normal(0, sigma, action.shape), 0, 1).astype(np.float32)
                for agent, action in self.act(observations).items()
            }
            observations, rewards, terminations, *_ = self.env.step(actions)
            next_joint_obs = np.concatenate([observations[agent] for agent in self.agents])
            transition = (
                joint_obs,
                np.concatenate(list(actions.values())),
                next_joint_obs,
                [rewards[agent] for agent in self.agents],
                [terminations[agent] for agent in self.agents],
            )
            for storage, values in zip(self.buffer, transition, strict=True):
                storage[self.size % common.BUFFER_SIZE] = values
            self.size += 1
            joint_obs = next_joint_obs
            if not self.env.agents:
                observations, _ = self.env.reset()
                joint_obs = np.concatenate([observations[agent] for agent in self.agents])
            if self.size >= common.LEARNING_STARTS and self.size % self.task.train_freq == 0:
                self.update()
        clock.stop()

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        with th.no_grad():
            return {
                agent: actor(th.from_numpy(observations[agent])).sigmoid().numpy()
                for agent, actor in zip(self.agents, self.actors, strict=True)
            }

    def network(self, agent: str) -> nn.Module:
        return nn.Sequential(*self.actors[self.agents.index(agent)], nn.Sigmoid())

    def update(self) -> None:
        rows = self.rng.integers(min(self.size, common.BUFFER_SIZE), size=common.BATCH_SIZE)
        obs, actions, next_obs, rewards, dones = (th.from_numpy(storage[rows]) for storage in self.buffer)
        agent_obs, agent_actions = obs.split(self.obs_dims, 1), actions.split(self.action_dims, 1)
        with th.no_grad():
            parts = zip(self.actor_targets, next_obs.split(self.obs_dims, 1), strict=True)
            next_joint = th.cat([next_obs, *(target(part).sigmoid() for target, part in parts)], 1)
        for i in range(len(self.agents)):
            with th.no_grad():
                next_value = self.critic_targets[i](next_joint).squeeze(1)
                target = rewards[:, i] + common.GAMMA * (1 - dones[:, i]) * next_value
            value = self.critics[i](th.cat([obs, actions], 1)).squeeze(1)
            self.descend(self.critics[i], self.critic_optimizers[i], nn.functional.mse_loss(value, target))

            logits = self.actors[i](agent_obs[i])
            own = [*agent_actions[:i], logits.sigmoid(), *agent_actions[i + 1 :]]
            loss = -self.critics[i](th.cat([obs, *own], 1)).mean() + 1e-3 * logits.square().mean()
            self.descend(self.actors[i], self.actor_optimizers[i], loss)
        with th.no_grad():
            nets, targets = self.actors + self.critics, self.actor_targets + self.critic_targets
            for net, target_net in zip(nets, targets, strict=True):
                for parameter, slow in zip(net.parameters(), target_net.parameters(), strict=True):
                    slow.lerp_(parameter, common.TAU)

    @staticmethod
    def descend(net: nn.Module, optimizer: th.optim.Optimizer, loss: th.Tensor) -> None:
        """Take one gradient step of a network with clipping."""
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), common.MAX_GRAD_NORM)
        optimizer.step()


if __name__ == "__main__":
    common.main("plain PyTorch", "torch", Plain)
