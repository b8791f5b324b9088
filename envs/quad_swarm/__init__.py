"""A quadrotor swarm with NMPC planners whose robots may request each other's plans (Serra-Gomez et al., IROS 2020).

Importing the package registers ``QuadSwarm-v0`` in Gymnasium. `parallel_env` creates the PettingZoo environment.
"""

from importlib.metadata import version

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

__version__ = version("sb3-maddpg")
__all__ = [
    "PRESETS",
    "PRESET_VERSION",
    "SCENARIOS",
    "QuadSwarmEnv",
    "QuadSwarmParallelEnv",
    "QuadSwarmVectorEnv",
    "parallel_env",
]
