"""MADDPG of this repository, see ``common``. It logs to TensorBoard, as XuanCe does."""

from pathlib import Path

import numpy as np
from torch import nn

from benchmarks.peers import common
from sb3_maddpg import MADDPG


class Ours:
    """``MADDPG`` in the unmodified PettingZoo environment."""

    algorithm: type[MADDPG] = MADDPG
    first_update = common.LEARNING_STARTS

    def __init__(self, task: common.Task) -> None:
        self.task = task
        self.model = self.algorithm(
            "MlpPolicy",
            common.parallel_env(task.env),
            learning_rate=common.LEARNING_RATE,
            buffer_size=common.BUFFER_SIZE,
            learning_starts=common.LEARNING_STARTS,
            batch_size=common.BATCH_SIZE,
            tau=common.TAU,
            gamma=common.GAMMA,
            train_freq=task.train_freq,
            gradient_steps=1,
            # In units of [-1, 1], which is twice as wide as the actions
            exploration_noise=(2 * common.SIGMA_START, 2 * common.SIGMA_END),
            max_grad_norm=common.MAX_GRAD_NORM,
            policy_kwargs={
                "net_arch": list(common.HIDDEN),
                "share_actor": task.shared,
                "share_critic": "team" if task.networks == "team" else task.shared,
            },
            tensorboard_log=str(Path.cwd()),
            seed=task.seed,
            device="cpu",
        )

    def train(self, warm_up: int, clock: common.Clock) -> None:
        if warm_up:
            self.model.learn(warm_up)
        clock.start()
        self.model.learn(self.task.steps - warm_up, reset_num_timesteps=not warm_up)
        clock.stop()
        self.policies = {agent: self.model.agent_policy(agent) for agent in self.model.policy.team.names}

    def update(self) -> None:
        self.model.train(gradient_steps=1, batch_size=common.BATCH_SIZE)

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {agent: self.policies[agent].predict(observation)[0] for agent, observation in observations.items()}

    def network(self, agent: str) -> nn.Module:
        return self.policies[agent]


if __name__ == "__main__":
    common.main("sb3-maddpg", "sb3-maddpg", Ours)
