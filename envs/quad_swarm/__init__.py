"""A quadrotor swarm with NMPC planners whose robots may ask each other for their plans (Serra-Gomez et al., IROS 2020).

Importing registers ``QuadSwarm-v0`` with Gymnasium; `parallel_env` makes the PettingZoo interface.
"""

import gymnasium

from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.interfaces.parallel_env import QuadSwarmParallelEnv
from quad_swarm.interfaces.vector_env import QuadSwarmVectorEnv
from quad_swarm.world.presets import PRESET_VERSION, PRESETS
from quad_swarm.world.scenarios import SCENARIOS

parallel_env = QuadSwarmParallelEnv

if "QuadSwarm-v0" not in gymnasium.registry:
    gymnasium.register(
        "QuadSwarm-v0",
        entry_point="quad_swarm.interfaces.env:QuadSwarmEnv",
        vector_entry_point="quad_swarm.interfaces.vector_env:QuadSwarmVectorEnv",
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
