"""A quadrotor swarm with NMPC planners whose robots may request each other's plans (Serra-Gomez et al., IROS 2020).

Importing the package registers ``QuadSwarm-v0`` in Gymnasium, now or when Gymnasium is imported, which a robot of its
own does not do. `parallel_env` creates the PettingZoo environment.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
from typing import Any

from wrapt import register_post_import_hook

# Public name -> the module that defines it, and its name there
_MODULES = {
    "PRESETS": ("world.presets", "PRESETS"),
    "PRESET_VERSION": ("world.presets", "PRESET_VERSION"),
    "SCENARIOS": ("world.scenarios", "SCENARIOS"),
    "QuadSwarmEnv": ("interfaces.env", "QuadSwarmEnv"),
    "QuadSwarmParallelEnv": ("interfaces.parallel_env", "QuadSwarmParallelEnv"),
    "QuadSwarmVectorEnv": ("interfaces.vector_env", "QuadSwarmVectorEnv"),
    "parallel_env": ("interfaces.parallel_env", "QuadSwarmParallelEnv"),
}

__all__ = [
    "PRESETS",
    "PRESET_VERSION",
    "SCENARIOS",
    "QuadSwarmEnv",
    "QuadSwarmParallelEnv",
    "QuadSwarmVectorEnv",
    "parallel_env",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that a robot need not load what only learners need."""
    if name == "__version__":
        try:
            found: Any = version("sb3-maddpg")
        except PackageNotFoundError:  # the swarm alone
            found = version("quad-swarm")
    elif name in _MODULES:
        module, there = _MODULES[name]
        found = getattr(import_module(f"quad_swarm.{module}"), there)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


def _register(gymnasium: ModuleType) -> None:
    if "QuadSwarm-v0" not in gymnasium.registry:
        gymnasium.register(
            "QuadSwarm-v0",
            entry_point="quad_swarm.interfaces.env:QuadSwarmEnv",
            vector_entry_point="quad_swarm.interfaces.vector_env:QuadSwarmVectorEnv",
        )


register_post_import_hook(_register, "gymnasium")
