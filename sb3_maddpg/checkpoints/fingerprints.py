"""What the exact results of a training depend on."""

from __future__ import annotations

import importlib.metadata
import platform
import warnings
from collections.abc import Mapping

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.utils import sources_of
from sb3_maddpg.vec_env.states import layers

# Distributions whose versions exact results depend on
_DISTRIBUTIONS = ("sb3-maddpg", "stable-baselines3", "gymnasium", "pettingzoo")
# Packages of environments that are named by their versions
_BY_VERSION = {name.replace("-", "_") for name in _DISTRIBUTIONS}


def fingerprint(env: VecEnv | None = None) -> dict[str, str]:
    """
    :param env: the environment of a training
    :return: the hardware, the versions and the sources that the exact results of training depend on: those of the
        libraries, of this package, of the environment and its wrappers, and what the environment ``depends_on``
    """
    parts = [] if env is None else list(layers(env))
    modules = {type(one).__module__ for one in parts}
    sources = {module.partition(".")[0]: sources_of(module) for module in sorted(modules)}
    told = next((one for part in parts if isinstance(one := getattr(part, "depends_on", None), Mapping)), {})
    return {
        "processor": f"{platform.machine()} {platform.processor()} {th.backends.cpu.get_cpu_capability()}",
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "torch": str(th.__version__),
        "numpy": np.__version__,
        **{name: version for name in _DISTRIBUTIONS if (version := _version(name))},
        "threads": str(th.get_num_threads()),
        "sources of sb3_maddpg": sources_of("sb3_maddpg"),
        **{f"sources of {name}": digest for name, digest in sources.items() if digest and name not in _BY_VERSION},
        **{f"environment's {name}": str(value) for name, value in told.items()},
    }


def compare_fingerprints(written: dict[str, str], here: dict[str, str]) -> None:
    """Say in one line what differs from the fingerprint in a checkpoint, which earlier versions wrote shorter."""
    differ = [
        f"{name}: {written.get(name, 'unknown')} before, {here.get(name, 'none')} now"
        for name in {**here, **written}
        if written.get(name) != here.get(name)
    ]
    if differ:
        warnings.warn(f"The run continues, but may not be bit-identical: {'; '.join(differ)}.", stacklevel=3)


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
