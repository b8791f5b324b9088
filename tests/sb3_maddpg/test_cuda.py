"""The same numbers on a GPU as on the processor, up to rounding. Skipped without a GPU."""

import numpy as np
import pytest
import torch as th

from quad_swarm import QuadSwarmEnv
from sb3_maddpg import MADDPG, MATD3, PrioritizedTeamReplayBuffer
from sb3_maddpg.team.toys import OwnBit

DEVICE = "cuda"
pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


def swarm():
    return QuadSwarmEnv(observation="state+approach+memory+plan", max_steps=20)


CASES = {
    "flat": (MADDPG, OwnBit, {"policy": "MlpPolicy"}),
    "prioritised": (MADDPG, OwnBit, {"policy": "MlpPolicy", "replay_buffer_class": PrioritizedTeamReplayBuffer}),
    "MATD3": (MATD3, OwnBit, {"policy": "MlpPolicy", "target_policy_noise": 0.0}),
    "pairs": (MADDPG, swarm, {"policy": "PairPolicy", "policy_kwargs": {"pair_credit": True}, "n_steps": 3}),
}


@pytest.mark.parametrize("name", CASES)
def test_updates_and_actions_agree(name, tmp_path):
    algorithm, env, kwargs = CASES[name]
    models = []
    for device in ("cpu", DEVICE):
        model = algorithm(env=env(), learning_starts=200, batch_size=64, seed=0, device=device, **kwargs)
        model.learn(200)  # random actions, the same on both
        np.random.seed(1)  # noqa: NPY002 - what the replay buffer draws from
        model.train(gradient_steps=5, batch_size=64)
        models.append(model)
    on_cpu, on_gpu = (one.policy.state_dict() for one in models)
    for key, value in on_cpu.items():
        assert on_gpu[key].device.type == th.device(DEVICE).type
        th.testing.assert_close(on_gpu[key].cpu(), value, rtol=1e-3, atol=1e-4, msg=key)
    observation, _ = env().reset(seed=3)
    path = tmp_path / "model.zip"
    models[1].save(path)
    again = algorithm.load(path, device="cpu")
    expected, _ = models[1].predict(observation, deterministic=True)
    actions, _ = again.predict(observation, deterministic=True)
    assert np.array_equal(actions, expected)
