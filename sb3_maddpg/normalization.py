"""``VecNormalize`` with statistics saved as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_maddpg.model_files import as_damage, trusted
from sb3_maddpg.typed_json import decode, encode
from sb3_maddpg.utils import atomic_write
from sb3_maddpg.validation import NormalizationArguments, validated_as

_FORMAT = "VecNormalize 1"
_SETTINGS = tuple(NormalizationArguments.model_fields)
_MOST_BYTES = 2**28


class SafeVecNormalize(VecNormalize):
    """
    SB3's ``VecNormalize``, saved as JSON instead of a pickle and loaded without running code.

    :param args: see ``VecNormalize``
    :param kwargs: see ``VecNormalize``
    """

    def save(self, save_path: str) -> None:
        """
        Save the statistics atomically.

        :param save_path: path of the file
        """
        rms = self.obs_rms if self.norm_obs else {}
        data = {
            "format": _FORMAT,
            "settings": {name: getattr(self, name) for name in _SETTINGS},
            "obs_rms": {key: _moments(one) for key, one in rms.items()} if isinstance(rms, dict) else _moments(rms),
            "ret_rms": _moments(self.ret_rms),
        }
        with atomic_write(save_path, suffix="pkl") as file:
            file.write(json.dumps({key: encode(value, key) for key, value in data.items()}).encode())

    @staticmethod
    def load(load_path: str, venv: VecEnv, trust: bool | None = None) -> VecNormalize:
        """
        Load statistics and wrap a vectorised environment.

        :param load_path: path of a file that ``save`` wrote
        :param venv: the environment to wrap
        :param trust: also load a pickled file of Stable-Baselines3, which can run code. By default, the environment
            variable ``SB3_MADDPG_TRUST`` decides (1 means yes).
        :return: the wrapped environment
        :raises ValueError: if the file holds no statistics, or statistics of other observations, or is pickled and not
            trusted
        """
        path = Path(load_path)
        if not path.suffix and not path.exists():
            path = path.with_suffix(".pkl")  # which `save` has added
        with path.open("rb") as file:
            start = file.read(1)
        with as_damage(path, "statistics"):
            if start != b"{":
                if trusted(trust):
                    return VecNormalize.load(str(path), venv)
                raise ValueError(
                    f"{path} does not hold statistics that this version writes. If it is pickled, it may run any code "
                    "when it is loaded: if you trust its author, load it with `trust=True` (on the command line "
                    "`--trust`)."
                )
            if path.stat().st_size > _MOST_BYTES:
                raise ValueError(f"{path} is too large to hold statistics.")
            data = json.loads(path.read_bytes())
            if data.get("format") != _FORMAT:
                raise ValueError(
                    f"{path} has format {data.get('format')}, but this version of sb3-maddpg reads {_FORMAT}."
                )
            settings = decode(data["settings"], f"{path}: settings")
            given = validated_as(NormalizationArguments, settings, lambda name: f"{path}: {name}")
            found = SafeVecNormalize(venv, **given)
            if isinstance(found.obs_rms if found.norm_obs else None, dict):
                for key, one in found.obs_rms.items():
                    _set_moments(one, data["obs_rms"][key], f"{path}: {key}")
            elif found.norm_obs:
                _set_moments(found.obs_rms, data["obs_rms"], f"{path}: obs_rms")  # type: ignore[arg-type]
            _set_moments(found.ret_rms, data["ret_rms"], f"{path}: ret_rms")
        return found


def _moments(rms: RunningMeanStd) -> dict[str, Any]:
    return {"mean": np.asarray(rms.mean), "var": np.asarray(rms.var), "count": float(rms.count)}


def _set_moments(rms: RunningMeanStd, data: Any, name: str) -> None:
    mean, var, count = (decode(data[key], f"{name}: {key}") for key in ("mean", "var", "count"))
    for array in (mean, var):
        if not isinstance(array, np.ndarray) or array.shape != np.shape(rms.mean):
            raise ValueError(
                f"{name} has shape {np.shape(array)}, but the environment needs {np.shape(rms.mean)}: these are "
                "statistics of other observations."
            )
    if not (np.isfinite(mean).all() and np.isfinite(var).all() and (var >= 0).all() and 0 < count < np.inf):
        raise ValueError(f"{name} holds NaN, infinity or a negative variance.")
    rms.mean, rms.var, rms.count = mean.astype(np.float64), var.astype(np.float64), float(count)
