"""Deploy the actor of a single agent: ``python examples/deploy_actor.py [--quick]``.

A robot needs neither the critics nor the other actors, nor this package: TorchScript runs in Python and in C++.
"""

import argparse

import numpy as np
import torch
from mpe2 import simple_speaker_listener_v4

from sb3_maddpg import MADDPG

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--quick", action="store_true", help="only a few steps, as a test")
quick = parser.parse_args().quick

env = simple_speaker_listener_v4.parallel_env(continuous_actions=True)
model = MADDPG("MlpPolicy", env, gamma=0.95, learning_starts=200 if quick else 5000, seed=0)
model.learn(500 if quick else 100_000)

listener = model.agent_policy("listener_0")
listener.export("listener.pt")

# From here on, only PyTorch is used, as on the robot
actor = torch.jit.load("listener.pt")
observations, _ = env.reset(seed=1)
seen = observations["listener_0"]
action = actor(torch.as_tensor(seen)[None])[0].numpy()
expected, _ = listener.predict(seen)
print("with the package:", expected)
print("without:         ", action)
assert np.allclose(action, expected, atol=1e-5)
