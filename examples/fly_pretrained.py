"""Fly a pretrained model and render it: ``python examples/fly_pretrained.py [--quick]``."""

import argparse

import gymnasium
from PIL import Image

from sb3_maddpg import pretrained

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--quick", action="store_true", help="only a few steps, as a test")
quick = parser.parse_args().quick

model = pretrained("quad-swarm-paper")
kwargs = model.env_spec["kwargs"] | {"scenario": "symmetric_swap"}  # the world of its training
for n_robots in (4, 6):
    env = gymnasium.make("quad_swarm:QuadSwarm-v0", render_mode="rgb_array", **kwargs | {"n_robots": n_robots})
    # One network for all pairs of robots fits a team of any size
    model = pretrained("quad-swarm-paper", env=env)
    observation, _ = env.reset(seed=5)
    pictures, requests, over = [], 0, False
    while not over:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        requests += info["n_requests"]
        pictures.append(Image.fromarray(env.render()))
        over = terminated or truncated or (quick and len(pictures) == 10)
    everybody = n_robots * (n_robots - 1) * len(pictures)
    print(f"{n_robots} robots: {requests} requests of {everybody} possible, collision: {info['collision']}")
    pictures[0].save(
        f"swarm_{n_robots}.gif",
        save_all=True,
        append_images=pictures[1:],
        duration=1000 / env.metadata["render_fps"],
        loop=0,
    )
