"""MADDPG of XuanCe, see ``common``.

Forced: it always logs to TensorBoard. Networks have orthogonal initialisation. Shared networks get an agent id and
process all agents in one batch.
"""

from argparse import Namespace
from pathlib import Path

import numpy as np
import torch as th
import xuance
import yaml
from torch import nn

from benchmarks.peers import common

common.restore_pettingzoo_mpe()

from xuance.environment import make_envs  # noqa: E402
from xuance.torch.agents import MADDPG_Agents  # noqa: E402


class Policy(nn.Module):
    """An actor after its representation, which returns a dictionary."""

    def __init__(self, representation: nn.Module, actor: nn.Module):
        super().__init__()
        self.representation, self.actor = representation, actor

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.actor(self.representation(obs)["state"])


class XuanCe:
    """The library's ``MADDPG_Agents`` with its own adapter of the environment."""

    first_update = common.LEARNING_STARTS

    def __init__(self, task: common.Task) -> None:
        configs = Path(xuance.__file__).parent / "configs"
        # The library's settings of MADDPG in MPE only differ in sizes between environments
        settings = yaml.safe_load((configs / "basic.yaml").read_text())
        settings |= yaml.safe_load((configs / "maddpg/mpe/simple_spread_v3.yaml").read_text())
        settings |= {
            "env_id": task.env,
            "env_seed": task.seed,
            "seed": task.seed,
            "parallels": 1,
            "render": False,
            "actor_hidden_size": list(common.HIDDEN),
            "critic_hidden_size": list(common.HIDDEN),
            "activation": "relu",
            "use_parameter_sharing": task.shared,
            "buffer_size": common.BUFFER_SIZE,
            "batch_size": common.BATCH_SIZE,
            "learning_rate_actor": common.LEARNING_RATE,
            "learning_rate_critic": common.LEARNING_RATE,
            "end_factor_lr_decay": 1.0,
            "gamma": common.GAMMA,
            "tau": common.TAU,
            "use_grad_clip": True,
            "grad_clip_norm": common.MAX_GRAD_NORM,
            "start_noise": common.SIGMA_START,
            "end_noise": common.SIGMA_END,
            "start_training": common.LEARNING_STARTS,
            "training_frequency": task.train_freq,
            "running_steps": task.steps,
        }
        config = Namespace(**settings)
        self.task = task
        self.agents = MADDPG_Agents(config, make_envs(config))

    def train(self, warm_up: int, clock: common.Clock) -> None:
        if warm_up:
            self.agents.train(warm_up)
        clock.start()
        self.agents.train(self.task.steps - warm_up)
        clock.stop()

    def update(self) -> None:
        self.agents.train_epochs(1)

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return self.agents.get_actions([observations], test_mode=True)["actions"][0]

    def network(self, agent: str) -> nn.Module:
        policy = self.agents.policy
        return Policy(policy.actor_representation[agent], policy.actor[agent])


if __name__ == "__main__":
    common.main("XuanCe", "xuance", XuanCe)
