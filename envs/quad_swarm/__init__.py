"""A quadrotor swarm with NMPC planners whose robots may ask each other for their plans (Serra-Gomez et al., IROS 2020).

Importing registers ``QuadSwarm-v0`` with Gymnasium; `parallel_env` makes the PettingZoo face.
"""

import gymnasium

from .env import QuadSwarmEnv
from .parallel import QuadSwarmParallelEnv
from .presets import PRESET_VERSION, PRESETS
from .scenarios import SCENARIOS
from .vector import QuadSwarmVectorEnv

parallel_env = QuadSwarmParallelEnv

if "QuadSwarm-v0" not in gymnasium.registry:
    gymnasium.register(
        "QuadSwarm-v0",
        entry_point="quad_swarm.env:QuadSwarmEnv",
        vector_entry_point="quad_swarm.vector:QuadSwarmVectorEnv",
    )

__all__ = [
    "PRESETS",
    "PRESET_VERSION",
    "SCENARIOS",
    "QuadSwarmEnv",
    "QuadSwarmParallelEnv",
    "QuadSwarmVectorEnv",
    "parallel_env",
]
