"""MADDPG of BenchMARL, see ``common``.

Forced: an agent's critic sees the global state and the actions of its own group only, so in a task with two sides not
those of the other side; gradients are clipped by the norm of all networks of a group together; learning starts after
the first batch of ``train_freq`` steps. A shared critic has a single value for the whole group without an agent id:
``--networks team``.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from tensordict import TensorDict
from torch import nn

from benchmarks.peers import common

common.restore_pettingzoo_mpe()

from benchmarl.algorithms import MaddpgConfig  # noqa: E402
from benchmarl.environments import PettingZooTask  # noqa: E402
from benchmarl.experiment import Callback, Experiment, ExperimentConfig  # noqa: E402
from benchmarl.models.mlp import MlpConfig  # noqa: E402
from torchrl.envs.utils import ExplorationType, set_exploration_type  # noqa: E402

# Settings that differ from the library's own configuration
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "simple_spread_v3": ("SIMPLE_SPREAD", {"N": 3, "local_ratio": 0.5}),
    "simple_tag_v3": ("SIMPLE_TAG", {"num_good": 1, "num_adversaries": 3, "num_obstacles": 2}),
    "simple_adversary_v3": ("SIMPLE_ADVERSARY", {"N": 2}),
    "simple_speaker_listener_v4": ("SIMPLE_SPEAKER_LISTENER", {}),
}


class StartClock(Callback):
    """Start the clock after the warm-up."""

    def __init__(self, warm_up: int, clock: common.Clock) -> None:
        super().__init__()
        self.warm_up, self.clock = warm_up, clock
        self.started = False

    def on_train_end(self, training_td: TensorDict, group: str) -> None:
        if not self.started and self.experiment.total_frames >= self.warm_up:
            self.started = True
            self.clock.start()


class Squash(nn.Module):
    """The library's ``TanhDelta`` on [0, 1], which adds the centre of the bounds before the hyperbolic tangent."""

    def forward(self, outputs: th.Tensor) -> th.Tensor:
        return 0.5 * ((outputs + 0.5).tanh() + 1.0)


class BenchMARL:
    """The library's ``Experiment`` without loggers and evaluation."""

    first_update = 0

    def __init__(self, task: common.Task) -> None:
        self.task = task
        name, arguments = TASKS[task.env]
        pettingzoo_task = PettingZooTask[name].get_from_yaml()
        pettingzoo_task.config |= {"max_cycles": 25, **arguments}
        config = ExperimentConfig.get_from_yaml()
        for key, value in self.settings(task).items():
            assert hasattr(config, key), key
            setattr(config, key, value)
        model = MlpConfig(num_cells=list(common.HIDDEN), layer_class=nn.Linear, activation_class=nn.ReLU)
        self.experiment = Experiment(
            pettingzoo_task,
            MaddpgConfig(share_param_critic=task.shared, loss_function="l2", delay_value=True, use_tanh_mapping=True),
            model,
            task.seed,
            config,
            critic_model_config=MlpConfig(**vars(model)),
        )

    @staticmethod
    def settings(task: common.Task) -> dict[str, Any]:
        """:return: settings that differ from the library's own configuration"""
        return {
            "share_policy_params": task.shared,
            "gamma": common.GAMMA,
            "lr": common.LEARNING_RATE,
            "clip_grad_norm": True,
            "clip_grad_val": common.MAX_GRAD_NORM,
            "polyak_tau": common.TAU,
            "exploration_eps_init": common.SIGMA_START,
            "exploration_eps_end": common.SIGMA_END,
            "exploration_anneal_frames": task.steps,
            "max_n_frames": task.steps,
            "off_policy_collected_frames_per_batch": task.train_freq,
            "off_policy_n_envs_per_worker": 1,
            "off_policy_n_optimizer_steps": 1,
            "off_policy_train_batch_size": common.BATCH_SIZE,
            "off_policy_memory_size": common.BUFFER_SIZE,
            "evaluation": False,
            "render": False,
            "loggers": [],
            "create_json": False,
            "save_folder": str(Path.cwd()),
        }

    def train(self, warm_up: int, clock: common.Clock) -> None:
        callback = StartClock(warm_up, clock)
        callback.experiment = self.experiment
        self.experiment.callbacks.append(callback)
        if not warm_up:
            callback.started = True
            clock.start()
        self.experiment.run()
        clock.stop()

    def update(self) -> None:
        for group in self.experiment.group_map:
            self.experiment._optimizer_loop(group)

    def act(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        actions: dict[str, np.ndarray] = {}
        with th.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for group, agents in self.experiment.group_map.items():
                rows = th.from_numpy(np.stack([observations[agent] for agent in agents]))
                batch = TensorDict({group: TensorDict({"observation": rows}, [len(agents)])}, [])
                chosen = self.experiment.algorithm.get_policy_for_loss(group)(batch)[group, "action"]
                actions |= dict(zip(agents, chosen.numpy(), strict=True))
        return actions

    def network(self, agent: str) -> nn.Module:
        group = next(group for group, agents in self.experiment.group_map.items() if agent in agents)
        policy = self.experiment.algorithm.get_policy_for_loss(group)
        row = self.experiment.group_map[group].index(agent)
        # The parameters of the whole group, stacked; what comes after the last layer is its TanhDelta on [0, 1]
        parameters = [
            (name, weights[row].detach()) for name, weights in policy.named_parameters() if len(weights.shape) > 1
        ]
        biases = [values for name, values in parameters if name.endswith("bias")]
        layers: list[nn.Module] = []
        for weight, bias in zip(
            (values for name, values in parameters if name.endswith("weight")), biases, strict=True
        ):
            linear = nn.Linear(weight.shape[1], weight.shape[0])
            linear.load_state_dict({"weight": weight, "bias": bias})
            layers += [linear, nn.ReLU()]
        return nn.Sequential(*layers[:-1], Squash())


if __name__ == "__main__":
    common.main("BenchMARL", "benchmarl", BenchMARL)
