"""MADDPG in one file, to read: ``python examples/maddpg_single_file.py [--quick]``.

The algorithm of Lowe et al. (2017), https://arxiv.org/abs/1706.02275, for continuous actions, without anything around
it: no vectorised environments, no files, no logging. With the same networks and the same batch, ``update`` does what
``sb3_maddpg.MADDPG`` does in one update, only slower: it has a loop over agents where the package has one product of
matrices. A test compares the two.
"""

import argparse
from copy import deepcopy

import numpy as np
import torch
from mpe2 import simple_spread_v3
from torch import nn

GAMMA, TAU = 0.95, 0.01
LEARNING_RATE, MAX_GRAD_NORM, REGULARIZATION = 0.01, 0.5, 1e-3
BATCH_SIZE, STEPS_PER_UPDATE = 1024, 100


def mlp(n_inputs: int, n_outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, n_outputs))


class Agent:
    """One agent: an actor of its own observation, a critic of all observations and actions, and their targets."""

    def __init__(self, obs_dim: int, action_dim: int, all_obs_dim: int, all_action_dim: int):
        self.actor = mlp(obs_dim, action_dim)
        self.critic = mlp(all_obs_dim + all_action_dim, 1)
        self.actor_target, self.critic_target = deepcopy(self.actor), deepcopy(self.critic)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), LEARNING_RATE)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), LEARNING_RATE)


def act(actor: nn.Module, obs: torch.Tensor) -> torch.Tensor:
    """Actions in [-1, 1], of half the usual slope at 0: with tanh(x), simple_spread learns worse."""
    return torch.tanh(0.5 * actor(obs))


def value(critic: nn.Module, obs: list[torch.Tensor], actions: list[torch.Tensor]) -> torch.Tensor:
    return critic(torch.cat([*obs, *actions], dim=1)).squeeze(1)


def descend(network: nn.Module, optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), MAX_GRAD_NORM)
    optimizer.step()


def update(
    agents: list[Agent],
    obs: list[torch.Tensor],
    actions: list[torch.Tensor],
    rewards: list[torch.Tensor],
    next_obs: list[torch.Tensor],
    terminated: list[torch.Tensor],
) -> None:
    """
    Take one step of gradient descent with every network.

    :param agents: the team
    :param obs: of each agent, (batch, its obs_dim)
    :param actions: of each agent, in [-1, 1], (batch, its action_dim)
    :param rewards: of each agent, (batch,)
    :param next_obs: of each agent, (batch, its obs_dim)
    :param terminated: of each agent, 1 if it terminated, (batch,)
    """
    with torch.no_grad():
        next_actions = [act(agent.actor_target, own) for agent, own in zip(agents, next_obs, strict=True)]
    for i, agent in enumerate(agents):
        # The critic learns what the agent's rewards are worth if everybody goes on with the target policies
        with torch.no_grad():
            target = rewards[i] + GAMMA * (1 - terminated[i]) * value(agent.critic_target, next_obs, next_actions)
        loss = (value(agent.critic, obs, actions) - target).square().mean()
        descend(agent.critic, agent.critic_optimizer, loss)

        # The actor learns actions of higher value, while the others keep theirs from the replay buffer
        output = agent.actor(obs[i])
        own = torch.tanh(0.5 * output)
        better = value(agent.critic, obs, [*actions[:i], own, *actions[i + 1 :]])
        descend(agent.actor, agent.actor_optimizer, (REGULARIZATION * output.square().mean(dim=1) - better).mean())

    with torch.no_grad():
        for agent in agents:
            for network, slow in ((agent.actor, agent.actor_target), (agent.critic, agent.critic_target)):
                for new, old in zip(network.parameters(), slow.parameters(), strict=True):
                    old.lerp_(new, TAU)


def main(steps: int, learning_starts: int) -> None:
    """:param steps: number of steps of the environment"""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    env = simple_spread_v3.parallel_env(continuous_actions=True)
    names = env.possible_agents
    low, high = ([getattr(env.action_space(name), bound) for name in names] for bound in ("low", "high"))
    obs_dims = [env.observation_space(name).shape[0] for name in names]
    agents = [
        Agent(own, len(bound), sum(obs_dims), sum(map(len, low))) for own, bound in zip(obs_dims, low, strict=True)
    ]

    memory: list[tuple] = []
    returns, total = [], 0.0
    observations, _ = env.reset(seed=0)
    for step in range(steps):
        seen = [observations[name] for name in names]
        noise = 0.6 + (0.1 - 0.6) * step / steps  # annealed over the training
        if step < learning_starts:
            actions = [rng.uniform(-1, 1, len(bound)).astype(np.float32) for bound in low]
        else:
            with torch.no_grad():
                best = [act(one.actor, torch.as_tensor(own)).numpy() for one, own in zip(agents, seen, strict=True)]
            actions = [np.clip(own + rng.normal(0, noise, own.shape), -1, 1).astype(np.float32) for own in best]
        in_env = {
            name: lowest + 0.5 * (own + 1) * (highest - lowest)
            for name, own, lowest, highest in zip(names, actions, low, high, strict=True)
        }
        observations, rewards, terminations, truncations, _ = env.step(in_env)
        total += sum(rewards.values()) / len(names)
        following = [observations[name] for name in names]
        ends = [float(terminations[name]) for name in names]
        memory.append((seen, actions, [rewards[name] for name in names], following, ends))
        if all(terminations.values()) or all(truncations.values()):
            returns.append(total)
            total, (observations, _) = 0.0, env.reset()

        if step >= learning_starts and step % STEPS_PER_UPDATE == 0:
            drawn = [memory[index] for index in rng.integers(len(memory), size=BATCH_SIZE)]
            # Of each of the five, a tensor per agent with the batch as its first axis
            batch = [
                [torch.as_tensor(np.stack(of_agent), dtype=torch.float32) for of_agent in zip(*part, strict=True)]
                for part in zip(*drawn, strict=True)
            ]
            update(agents, *batch)
        if returns and len(returns) % 400 == 0 and total == 0.0:
            print(f"step {step + 1:6}: mean return of the last 400 episodes {np.mean(returns[-400:]):.1f}")
    print(f"mean return of the last episodes: {np.mean(returns[-400:]):.1f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="only a few steps, as a test")
    torch.set_num_threads(1)
    main(*((2_000, 1_024) if parser.parse_args().quick else (100_000, 1_024)))
